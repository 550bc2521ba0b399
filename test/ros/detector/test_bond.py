"""The bond with a lifecycle manager: over the middleware against the manager's side of the protocol."""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterator
from contextlib import closing

import numpy as np
import pytest
from bond.msg import Constants, Status
from lifecycle_msgs.msg import Transition
from support.detector_process import PARAMETERS, as_arguments, detector_process
from support.preparations import Preparations, prediction
from support.served_node import PATIENCE_S, ServedNode

from yolov5_lifecycle.ros.detector.bond import CONNECT_S, Bond, check_bond
from yolov5_lifecycle.ros.detector.command import FINALIZED_S
from yolov5_lifecycle.ros.observer import Observer

MANY = 15
"""Heartbeats: more than can wait in a queue."""


@pytest.mark.end_to_end
def test_a_manager_drives_the_process_through_every_transition() -> None:
    """As Nav2's lifecycle manager of Jazzy does: transitions by number, the state asked after each."""
    assert FINALIZED_S >= 2 * 2.0, "the manager waits 2 s for the answer of get_state"
    heard: list[Status] = []
    with detector_process(*as_arguments({**PARAMETERS, "bond_timeout": PATIENCE_S})) as detector:
        detector.observer.create_subscription(Status, "/bond", heard.append, 100)

        def change(transition: int, state: str) -> None:
            assert detector.transition(transition_id=transition)
            assert detector.node.state() == state

        change(Transition.TRANSITION_CONFIGURE, "inactive")
        for _ in range(2):
            before = len(heard)
            change(Transition.TRANSITION_ACTIVATE, "active")
            detector.observer.wait_for(lambda: len(heard) > before + MANY, "heartbeats")  # noqa: B023
            change(Transition.TRANSITION_DEACTIVATE, "inactive")
            detector.observer.wait_for(lambda: not heard[-1].active, "the end that the node itself tells")
        assert len({message.instance_id for message in heard}) == 2
        change(Transition.TRANSITION_CLEANUP, "unconfigured")
        change(Transition.TRANSITION_UNCONFIGURED_SHUTDOWN, "finalized")
        assert detector.process.wait(PATIENCE_S) == 0
    assert "Traceback" not in detector.process.output


# The node in this process, with models of the test's


def test_the_bond_is_off_unless_it_is_asked_for(served: ServedNode) -> None:
    served.bring_to("active")
    assert served.client.count_publishers("/bond") == served.client.count_subscribers("/bond") == 0


@pytest.mark.long
def test_heartbeats_go_on_while_a_model_is_loaded_and_while_inference_hangs(prepare: Preparations) -> None:
    heard: list[Status] = []

    def take(message: Status) -> None:
        if message.instance_id != "manager":
            heard.append(message)

    def wait_for_more() -> None:
        wanted = len(heard) + MANY
        served.wait_for(lambda: len(heard) >= wanted, "heartbeats")

    def hang() -> np.ndarray:
        begun.set()
        assert release.wait(PATIENCE_S)
        return prediction("cat", 0.9)

    begun, release = threading.Event(), threading.Event()
    with ServedNode(prepare, parameters=["bond_timeout:=4.0"]) as served:
        served.client.create_subscription(Status, "/bond", take, 100)
        manager = served.client.create_publisher(Status, "/bond", 5)
        served.bring_to("active")
        served.wait_for(lambda: manager.get_subscription_count() == 2, "both subscriptions")
        manager.publish(Status(id="yolov5", instance_id="manager", active=True))
        served.wait_for_log("bonded with the lifecycle manager")
        assert prepare.begun.acquire(timeout=PATIENCE_S)
        prepare.gate.clear()
        reload = served.begin_set(image_size=320)
        assert prepare.begun.acquire(timeout=PATIENCE_S)
        wait_for_more()
        assert not reload.done()
        prepare.gate.set()
        served.wait_for(reload.done, "the reload")
        prepare.running.run = hang
        served.send_until(begun.is_set, "inference to begin")
        wait_for_more()
        release.set()
    assert served.escaped == []
    assert {message.heartbeat_timeout for message in heard if message.active} == {4.0}
    assert [message.active for message in heard].count(False) <= 1, "at the end"


def test_configure_says_what_a_bond_needs_where_its_messages_are_missing(
    prepare: Preparations, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ROS_DISTRO", "kilted")  # as a sourced ROS does
    monkeypatch.setitem(sys.modules, "bond.msg", None)  # as where nobody has installed it
    with ServedNode(prepare, parameters=["bond_timeout:=4.0"]) as served:
        assert not served.transition("configure")
        assert served.state() == "unconfigured"
        problem = served.values()["last problem"]
        needed = ("bond_timeout 4", "ros-kilted-bond", "bond_timeout 0.0")
        assert all(words in problem for words in needed)
    check_bond(0.0)


# One side alone, with a clock of the test's


class OneSide:
    """A node with a bond of 4 s, what it sends, and what is sent to it in the manager's name."""

    def __init__(self, observer: Observer, capture: pytest.CaptureFixture[str]) -> None:
        self.now_s = 100.0
        self.heard: list[Status] = []
        self._observer = observer
        self._capture = capture
        self._log = ""
        observer.create_subscription(Status, "/bond", self._take, 100)
        self._publisher = observer.create_publisher(Status, "/bond", 5)
        self.bond = self.another(4.0)

    def another(self, timeout_s: float) -> Bond:
        return Bond(self._observer, timeout_s, clock=lambda: self.now_s)

    def send(self, *, is_active: bool, node_name: str = "yolov5") -> None:
        self._observer.wait_for(lambda: self._publisher.get_subscription_count() == 2, "both subscriptions")
        self._publisher.publish(Status(id=node_name, instance_id="manager", active=is_active))

    def wait_for_more(self, count: int = 3) -> None:
        wanted = len(self.heard) + count
        self._observer.wait_for(lambda: len(self.heard) >= wanted, "heartbeats")

    def wait_for_log(self, text: str, *, count: int = 1) -> None:
        """Wait until the node has said `text` so many times."""

        def is_said() -> bool:
            self._log += self._capture.readouterr().err
            return self._log.count(text) == count

        self._observer.wait_for(is_said, f"{text!r} in the log")

    def wait_for_silence(self) -> None:
        """Wait until no heartbeat comes in the time of several; some may still be on their way."""

        def is_silent() -> bool:
            before = len(self.heard)
            self._observer.work_for(0.5)
            return len(self.heard) == before

        self._observer.wait_for(is_silent, "the end of the heartbeats")

    def _take(self, message: Status) -> None:
        if message.instance_id != "manager":
            self.heard.append(message)


@pytest.fixture
def side(ros_domain: int, capfd: pytest.CaptureFixture[str]) -> Iterator[OneSide]:
    with closing(Observer("yolov5", domain=ros_domain)) as observer:
        side = OneSide(observer, capfd)
        yield side
        side.bond.close()


def test_heartbeats_end_when_no_manager_joins_in_time(side: OneSide) -> None:
    assert CONNECT_S == Constants.DEFAULT_CONNECT_TIMEOUT
    side.send(is_active=True, node_name="amcl")
    side.send(is_active=False, node_name="amcl")
    side.now_s += CONNECT_S
    side.wait_for_more()
    assert all(message.active for message in side.heard)
    side.now_s += 0.1
    side.wait_for_log("no lifecycle manager joined the bond within 10 s; detection continues")
    side.wait_for_silence()


def test_the_end_of_the_bond_by_the_manager_is_acknowledged_and_ends_the_heartbeats(side: OneSide) -> None:
    side.send(is_active=True)
    side.wait_for_log("bonded with the lifecycle manager")
    side.send(is_active=False)
    side.wait_for_log("the lifecycle manager ended the bond; detection continues")
    side.send(is_active=True)
    side.wait_for_silence()
    assert [message.active for message in side.heard].count(False) == 1
    assert not side.heard[-1].active


def test_a_silent_manager_is_logged_once_and_the_heartbeats_go_on(side: OneSide) -> None:
    side.send(is_active=True)
    side.wait_for_log("bonded with the lifecycle manager")
    side.now_s += 4.1
    side.wait_for_log("no heartbeat from the lifecycle manager for 4 s; detection continues")
    side.wait_for_more()
    side.send(is_active=True)
    side.wait_for_log("bonded with the lifecycle manager", count=2)
    side.wait_for_log("no heartbeat from the lifecycle manager", count=1)
    assert all(message.active for message in side.heard)


@pytest.mark.parametrize(("timeout_s", "period_s"), [(60.0, 0.1), (0.2, 0.05), (0.001, 0.01)])
def test_several_heartbeats_of_another_bond_come_within_its_timeout(
    side: OneSide, timeout_s: float, period_s: float
) -> None:
    side.wait_for_more(1)
    side.bond.close()
    side.bond = side.another(timeout_s)
    side.wait_for_more()
    assert side.heard[-1].instance_id != side.heard[0].instance_id
    assert side.heard[-1].heartbeat_timeout == pytest.approx(timeout_s)
    assert side.heard[-1].heartbeat_period == pytest.approx(period_s)
