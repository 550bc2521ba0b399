"""The bond with a lifecycle manager: over the middleware against the manager's side of the protocol."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import closing, contextmanager

import numpy as np
import pytest
from bond.msg import Constants, Status
from support.detector_process import PARAMETERS, DetectorProcess, as_arguments, detector_process
from support.lifecycle_manager import LifecycleManager
from support.preparations import Preparations, prediction
from support.served_node import PATIENCE_S, ServedNode

from yolov5_lifecycle.ros.detector.bond import CONNECT_S, Bond, check_bond
from yolov5_lifecycle.ros.observer import Observer

MANY = 15
"""Heartbeats: more than can wait in a queue."""


# A manager and the detector's process


@contextmanager
def managed(**parameters: object) -> Iterator[tuple[DetectorProcess, Observer]]:
    """A detector's process, and a node for a manager that goes on when the process has ended."""
    with (
        detector_process(*as_arguments({**PARAMETERS, **parameters})) as detector,
        closing(Observer("lifecycle_manager", domain=detector.domain)) as observer,
    ):
        yield detector, observer


@pytest.mark.end_to_end
def test_a_manager_drives_the_process_through_every_transition() -> None:
    with managed(bond_timeout=PATIENCE_S) as (detector, observer):
        manager = LifecycleManager(observer, bond_timeout_s=PATIENCE_S)
        manager.startup()
        first = manager.bonds["yolov5"]
        manager.pause()
        assert first.is_broken
        assert not first.ended_by_timeout, "the node itself says that the bond ends"
        manager.resume()
        second = manager.bonds["yolov5"]
        observer.wait_for(lambda: len(second.heard) >= MANY, "heartbeats")
        assert {message.instance_id for message in second.heard}.isdisjoint(
            message.instance_id for message in first.heard
        )
        manager.shutdown()
        assert detector.process.stop(signal.SIGTERM) == 0
    assert "Traceback" not in detector.process.output


@pytest.mark.long
def test_a_manager_notices_that_the_process_was_killed() -> None:
    with managed(bond_timeout=1.0) as (detector, observer):
        manager = LifecycleManager(observer, bond_timeout_s=1.0)
        manager.startup()
        bond = manager.bonds["yolov5"]
        assert detector.process.stop(signal.SIGKILL) == -signal.SIGKILL
        observer.wait_for(lambda: bond.is_broken, "the end of the bond")
        assert bond.ended_by_timeout
        assert all(message.active for message in bond.heard)


# The node in this process, with models of the test's


@contextmanager
def served_with(*parameters: str) -> Iterator[tuple[ServedNode, Preparations]]:
    prepare = Preparations()
    with ServedNode(prepare, parameters=parameters) as served:
        yield served, prepare
    assert served.escaped == []


class BondSubscriber:
    """The node's messages on `bond`, taken by the client of `served`."""

    def __init__(self, served: ServedNode) -> None:
        self._served = served
        self.heard: list[Status] = []
        served.client.create_subscription(Status, "/bond", self._take, 100)
        self._publisher = served.client.create_publisher(Status, "/bond", 5)

    def join(self) -> None:
        """One heartbeat of a manager: without any, those of the node would end after `CONNECT_S`."""
        self._served.wait_for(lambda: self._publisher.get_subscription_count() == 2, "both subscriptions")
        self._publisher.publish(Status(id="yolov5", instance_id="manager", active=True))
        self._served.wait_for_log("bonded with the lifecycle manager")

    def wait_for_more(self) -> None:
        wanted = len(self.heard) + MANY
        self._served.wait_for(lambda: len(self.heard) >= wanted, "heartbeats")

    def _take(self, message: Status) -> None:
        if message.instance_id != "manager":
            self.heard.append(message)


def test_the_bond_is_off_unless_it_is_asked_for() -> None:
    with served_with() as (served, _):
        served.bring_to("active")
        assert served.client.count_publishers("/bond") == served.client.count_subscribers("/bond") == 0


@pytest.mark.long
def test_heartbeats_go_on_while_a_model_is_loaded_and_while_inference_hangs() -> None:
    with served_with("bond_timeout:=4.0") as (served, prepare):
        subscriber = BondSubscriber(served)
        served.bring_to("active")
        subscriber.join()
        assert prepare.begun.acquire(timeout=PATIENCE_S)
        prepare.gate.clear()
        reload = served.begin_set(image_size=320)
        assert prepare.begun.acquire(timeout=PATIENCE_S)
        subscriber.wait_for_more()
        assert not reload.done()
        prepare.gate.set()
        served.wait_for(reload.done, "the reload")
        begun, release = threading.Event(), threading.Event()

        def hang() -> np.ndarray:
            begun.set()
            assert release.wait(PATIENCE_S)
            return prediction("cat", 0.9)

        prepare.running.run = hang
        served.send_until(begun.is_set, "inference to begin")
        subscriber.wait_for_more()
        release.set()
        assert {(message.id, message.active, message.heartbeat_timeout) for message in subscriber.heard} == {
            ("yolov5", True, 4.0)
        }


@pytest.mark.long
@pytest.mark.parametrize("transition", ["deactivate", "shutdown"])
def test_a_node_that_is_no_longer_active_has_ended_its_bond(transition: str) -> None:
    with served_with("bond_timeout:=4.0") as (served, _):
        subscriber = BondSubscriber(served)
        served.bring_to("active")
        subscriber.join()
        subscriber.wait_for_more()
        assert served.transition(transition)
        served.wait_for(lambda: not subscriber.heard[-1].active, "the end of the bond")
        served.wait_for(
            lambda: served.client.count_publishers("/bond") == 1, "no publisher but the manager's to stay"
        )


@pytest.mark.parametrize("distribution", ["jazzy", "kilted"])
def test_configure_says_what_a_bond_needs_where_its_messages_are_missing(
    distribution: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ROS_DISTRO", distribution)  # as a sourced ROS does
    monkeypatch.setitem(sys.modules, "bond.msg", None)  # as where nobody has installed it
    with served_with("bond_timeout:=4.0") as (served, _):
        assert not served.transition("configure")
        assert served.state() == "unconfigured"
        problem = served.values()["last problem"]
        needed = ("bond_timeout 4", f"ros-{distribution}-bond", "bond_timeout 0.0")
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

    def wait_for_more(self, count: int = MANY) -> None:
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
    side.now_s += CONNECT_S
    side.wait_for_more()
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


def test_bonds_of_other_nodes_are_ignored(side: OneSide) -> None:
    side.send(is_active=True, node_name="amcl")
    side.send(is_active=False, node_name="amcl")
    side.wait_for_more()
    assert all(message.active for message in side.heard)


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


def test_a_bond_says_that_it_ends_and_the_next_one_is_another(side: OneSide) -> None:
    side.wait_for_more(1)
    side.bond.close()
    side.wait_for_silence()
    assert not side.heard[-1].active
    side.bond = side.another(4.0)
    side.wait_for_more(1)
    assert side.heard[-1].active
    assert side.heard[-1].instance_id != side.heard[0].instance_id


@pytest.mark.parametrize(("timeout_s", "period_s"), [(60.0, 0.1), (0.2, 0.05), (0.001, 0.01)])
def test_several_heartbeats_come_within_the_timeout(side: OneSide, timeout_s: float, period_s: float) -> None:
    side.bond.close()
    side.bond = side.another(timeout_s)
    side.wait_for_more(3)
    assert side.heard[-1].heartbeat_timeout == pytest.approx(timeout_s)
    assert side.heard[-1].heartbeat_period == pytest.approx(period_s)
