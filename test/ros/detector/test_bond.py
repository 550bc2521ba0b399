"""The bond with a lifecycle manager: over the middleware against the manager's side of the protocol."""

from __future__ import annotations

import sys
from contextlib import closing

import pytest
from bond.msg import Status
from lifecycle_msgs.msg import Transition
from support.detector_process import PARAMETERS, as_arguments, detector_process
from support.preparations import Preparations
from support.served_node import ServedNode

from yolov5_lifecycle.ros.detector.bond import Bond
from yolov5_lifecycle.ros.detector.command import FINALIZED_S
from yolov5_lifecycle.ros.observer import PATIENCE_S, Observer

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


def test_the_bond_is_off_unless_it_is_asked_for(active: ServedNode) -> None:
    assert active.client.count_publishers("/bond") == active.client.count_subscribers("/bond") == 0


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
    with ServedNode(prepare) as served:
        served.bring_to("inactive")


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
