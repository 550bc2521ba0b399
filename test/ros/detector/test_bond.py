"""The bond with a lifecycle manager: over the middleware against the manager's side of the protocol."""

from __future__ import annotations

import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager

import numpy as np
import pytest
from bond.msg import Status
from lifecycle_msgs.msg import State, Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rclpy.clock import Clock, ClockType
from support.detector_process import PARAMETERS, DetectorProcess, as_arguments, detector_process
from support.preparations import Preparations, prediction
from support.served_node import PATIENCE_S, ServedNode

from yolov5_lifecycle.ros.detector.bond import Bond, check_bond
from yolov5_lifecycle.ros.observer import Observer, RemoteLifecycleNode

MANY = 15
"""Heartbeats: more than can wait in a queue."""


# A manager and the detector's process


class ManagerBond:
    """The manager's side of the bond with the node; `heard` are the messages of the other side, in order."""

    def __init__(self, observer: Observer, timeout_s: float) -> None:
        self.heard: list[Status] = []
        self.is_broken = self.has_timed_out = False
        self._observer = observer
        self._timeout_s = timeout_s
        self._instance_id = f"manager-{time.monotonic_ns()}"
        self._heard_s = float("inf")
        self._publisher = observer.create_publisher(Status, "/bond", 5)
        observer.create_subscription(Status, "/bond", self._take, 100)
        observer.create_timer(0.1, self._beat, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def end(self) -> None:
        if not self.is_broken:
            self.is_broken = True
            self._publish(is_active=False)

    def _beat(self) -> None:
        if not self.is_broken:
            self.is_broken = self.has_timed_out = time.monotonic() - self._heard_s > self._timeout_s
            self._publish(is_active=True)

    def _take(self, message: Status) -> None:
        if message.id != "yolov5" or message.instance_id.startswith("manager") or self.is_broken:
            return
        self.heard.append(message)
        self._heard_s = time.monotonic()
        if not message.active:
            self.end()

    def _publish(self, *, is_active: bool) -> None:
        message = Status(id="yolov5", instance_id=self._instance_id, active=is_active)
        message.heartbeat_timeout, message.heartbeat_period = self._timeout_s, 0.1
        self._publisher.publish(message)


class LifecycleManager:
    """Leads the node as Nav2's lifecycle manager of Jazzy does, written again.

    After `nav2_lifecycle_manager/src/lifecycle_manager.cpp`, `nav2_util/src/lifecycle_service_client.cpp` and
    `bondcpp/src/bond.cpp`: the same requests in the same order, and the same messages on `bond`. Only its
    patience is longer, for a busy machine. It works only while its `Observer` waits for something.
    """

    def __init__(self, observer: Observer, bond_timeout_s: float) -> None:
        self.bond: ManagerBond | None = None
        self._observer = observer
        self._bond_timeout_s = bond_timeout_s
        self._change_state = observer.create_client(ChangeState, "/yolov5/change_state")
        self._get_state = observer.create_client(GetState, "/yolov5/get_state")
        # A node that answers a client made later has discovered these, too; it would lose earlier answers.
        RemoteLifecycleNode(observer, "/yolov5").wait_until_reachable()

    def startup(self) -> ManagerBond:
        self._change(Transition.TRANSITION_CONFIGURE, State.PRIMARY_STATE_INACTIVE)
        return self.resume()

    def resume(self) -> ManagerBond:
        self._change(Transition.TRANSITION_ACTIVATE, State.PRIMARY_STATE_ACTIVE)
        bond = self.bond = ManagerBond(self._observer, self._bond_timeout_s)
        self._observer.wait_for(lambda: bool(bond.heard), "the bond")
        return bond

    def pause(self) -> None:
        self._change(Transition.TRANSITION_DEACTIVATE, State.PRIMARY_STATE_INACTIVE)
        if self.bond is not None:
            self.bond.end()

    def shutdown(self) -> None:
        self.pause()
        self._change(Transition.TRANSITION_CLEANUP, State.PRIMARY_STATE_UNCONFIGURED)
        self._change(Transition.TRANSITION_UNCONFIGURED_SHUTDOWN, State.PRIMARY_STATE_FINALIZED)

    def _change(self, transition: int, state: int) -> None:
        # Nav2 waits for this answer without a limit, does not look at it, and then asks for the state.
        self._observer.call(self._change_state, ChangeState.Request(transition=Transition(id=transition)))
        answer = self._observer.call(self._get_state, GetState.Request())
        assert answer.current_state.id == state, answer.current_state.label


@contextmanager
def managed(bond_timeout_s: float) -> Iterator[tuple[DetectorProcess, Observer, LifecycleManager]]:
    """A detector's process, and a manager whose node goes on when the process has ended."""
    with (
        detector_process(*as_arguments({**PARAMETERS, "bond_timeout": bond_timeout_s})) as detector,
        closing(Observer("lifecycle_manager", domain=detector.domain)) as observer,
    ):
        yield detector, observer, LifecycleManager(observer, bond_timeout_s)


@pytest.mark.end_to_end
def test_a_manager_drives_the_process_through_every_transition() -> None:
    with managed(PATIENCE_S) as (detector, observer, manager):
        first = manager.startup()
        manager.pause()
        assert not first.heard[-1].active, "the node itself says that the bond ends"
        second = manager.resume()
        observer.wait_for(lambda: len(second.heard) >= MANY, "heartbeats")
        assert {message.instance_id for message in second.heard}.isdisjoint(
            message.instance_id for message in first.heard
        )
        manager.shutdown()
        assert detector.process.stop(signal.SIGTERM) == 0
    assert "Traceback" not in detector.process.output


@pytest.mark.long
def test_a_manager_notices_that_the_process_was_killed() -> None:
    with managed(1.0) as (detector, observer, manager):
        bond = manager.startup()
        assert detector.process.stop(signal.SIGKILL) == -signal.SIGKILL
        observer.wait_for(lambda: bond.is_broken, "the end of the bond")
        assert bond.has_timed_out
        assert all(message.active for message in bond.heard)


# The node in this process, with models of the test's


def test_the_bond_is_off_unless_it_is_asked_for(served: ServedNode) -> None:
    served.bring_to("active")
    assert served.client.count_publishers("/bond") == served.client.count_subscribers("/bond") == 0


@pytest.mark.long
def test_heartbeats_go_on_while_a_model_is_loaded_and_while_inference_hangs(prepare: Preparations) -> None:
    heard: list[Status] = []

    def wait_for_more() -> None:
        wanted = len(heard) + MANY
        served.wait_for(lambda: len(heard) >= wanted, "heartbeats")

    def hang() -> np.ndarray:
        begun.set()
        assert release.wait(PATIENCE_S)
        return prediction("cat", 0.9)

    begun, release = threading.Event(), threading.Event()
    with ServedNode(prepare, parameters=["bond_timeout:=4.0"]) as served:
        served.client.create_subscription(Status, "/bond", heard.append, 100)
        served.bring_to("active")
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


@pytest.mark.parametrize(("timeout_s", "period_s"), [(60.0, 0.1), (0.2, 0.05), (0.001, 0.01)])
def test_several_heartbeats_come_within_the_timeout_and_the_last_ends_the_bond(
    ros_domain: int, timeout_s: float, period_s: float
) -> None:
    heard: list[Status] = []

    def begin_and_end() -> None:
        wanted = len(heard) + 3
        with closing(Bond(observer, timeout_s)):
            observer.wait_for(lambda: len(heard) >= wanted, "heartbeats")
        observer.wait_for(lambda: not heard[-1].active, "the end of the bond")

    with closing(Observer("yolov5", domain=ros_domain)) as observer:
        observer.create_subscription(Status, "/bond", heard.append, 100)
        begin_and_end()
        begin_and_end()
    assert [message.active for message in heard].count(False) == 2
    assert len({message.instance_id for message in heard}) == 2
    assert heard[-1].id == "yolov5"
    assert heard[-1].heartbeat_timeout == pytest.approx(timeout_s)
    assert heard[-1].heartbeat_period == pytest.approx(period_s)
