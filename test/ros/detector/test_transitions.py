"""Every transition in every state: carried out, or refused without a change, also while a model loads."""

from __future__ import annotations

import time
from typing import Any

import pytest
from std_msgs.msg import String
from support.preparations import Preparations
from support.served_node import ServedNode, class_ids_of

from yolov5_lifecycle.ros.detector.node import EXIT_DEVICE_LOST
from yolov5_lifecycle.ros.observer import PATIENCE_S
from yolov5_lifecycle.runtimes.runtime import DeviceLostError

LEGAL = {
    "unconfigured": {"configure": 1, "shutdown": 5},
    "inactive": {"activate": 3, "cleanup": 2, "shutdown": 6},
    "active": {"deactivate": 4, "shutdown": 7},
    "finalized": {},
}
"""The transitions out of each state, and what lifecycle_msgs calls them."""
NO_FILE = "/no/such.pt: there is no such file"


def test_a_full_cycle_detects_only_while_active(served: ServedNode, prepare: Preparations) -> None:
    served.bring_to("inactive")
    assert prepare.runtimes == []
    for _ in range(2):
        assert served.transition("activate")
        assert class_ids_of(served.detect()) == ["cat"]
        assert served.transition("deactivate")
        assert prepare.running.is_closed
    assert served.transition("cleanup")
    assert served.transition("shutdown")
    assert served.state() == "finalized"
    assert [runtime.is_closed for runtime in prepare.runtimes] == [True, True]


@pytest.mark.parametrize("state", LEGAL)
def test_every_other_transition_is_refused_changes_nothing_and_does_not_flood_the_log(
    served: ServedNode, state: str
) -> None:
    """A process stays finalized for seconds and then ends; a node alone goes on answering."""
    legal = LEGAL[state]
    served.bring_to(state)
    begun_s = time.monotonic()
    for transition_id in sorted({*range(100), 255} - {*legal.values()}):
        assert not served.transition("", transition_id)
    for label in ("configure", "activate", "deactivate", "cleanup", "destroy", "nonsense"):
        assert label in legal or not served.transition(label, transition_id=7)
    most = time.monotonic() - begun_s + 1
    assert served.state() == state
    served.wait_for_log(f"refused in state {state}")
    assert sum(f"refused in state {state}" in said for said in served.log) <= most
    for transition_id in [*legal.values()][:1]:
        assert served.transition("", transition_id)
        assert served.state() != state


def test_an_unexpected_exception_in_activate_leads_back_to_unconfigured(
    served: ServedNode, prepare: Preparations
) -> None:
    prepare.refusal_type, prepare.refusal = KeyError, "surprise"
    served.bring_to("inactive")
    assert not served.transition("activate")
    assert served.state() == "unconfigured"
    assert "surprise" in served.status().message
    served.wait_for_log("Traceback")
    assert served.transition("configure")


@pytest.mark.parametrize("label", ["deactivate", "shutdown"])
def test_an_unexpected_exception_while_releasing_releases_the_rest(
    active: ServedNode, prepare: Preparations, label: str
) -> None:

    def fail_to_close() -> None:
        raise KeyError("surprise")

    prepare.running.on_close = fail_to_close
    assert not active.transition(label)
    assert active.state() == "unconfigured"
    active.wait_for_log(f"unexpected KeyError in on_{label}: 'surprise'")
    active.wait_for(lambda: active.image_subscriptions() == 0, "the node to unsubscribe")
    active.wait_for(lambda: active.client.count_publishers("/yolov5/detections") == 0, "the publishers to go")


def test_a_publisher_that_cannot_be_created_leaves_none_behind(served: ServedNode) -> None:
    # A participant of Fast DDS has one type for each topic.
    other = served.client.create_publisher(String, "/yolov5/masks", 1)
    assert not served.transition("configure")
    served.wait_for(lambda: served.client.count_publishers("/yolov5/detections") == 0, "the publishers to go")
    served.client.destroy_publisher(other)
    served.bring_to("inactive")
    assert served.client.count_publishers("/yolov5/detections") == 1


# While the model loads


def begin_loading(served: ServedNode, prepare: Preparations) -> Any:
    """Ask an inactive node to activate, which waits for `prepare.gate`; the future of the answer."""
    served.bring_to("inactive")
    prepare.gate.clear()
    answer = served.begin_transition("activate")
    assert prepare.begun.acquire(timeout=PATIENCE_S)
    return answer


def finish_loading(served: ServedNode, prepare: Preparations, *answers: Any) -> list[bool]:
    """Whether each `activate` succeeded."""
    prepare.gate.set()
    served.wait_for(lambda: all(answer.done() for answer in answers), "the answers")
    return [answer.result().success for answer in answers]


def test_services_answer_while_the_model_loads_and_a_second_activate_is_refused(
    served: ServedNode, prepare: Preparations
) -> None:
    activation = begin_loading(served, prepare)
    assert served.state() == "inactive"
    assert served.get("confidence_threshold") == 0.25
    assert not served.transition("activate")
    assert not activation.done()
    assert finish_loading(served, prepare, activation) == [True]
    assert served.state() == "active"
    assert len(prepare.runtimes) == 1


@pytest.mark.parametrize(
    ("label", "refusal", "state"),
    [("cleanup", NO_FILE, "unconfigured"), ("cleanup", "", "unconfigured"), ("shutdown", "", "finalized")],
)
def test_another_transition_wins_over_a_loading_activate(
    served: ServedNode, prepare: Preparations, label: str, refusal: str, state: str
) -> None:
    prepare.refusal = refusal
    activation = begin_loading(served, prepare)
    assert served.transition(label)
    assert finish_loading(served, prepare, activation) == [False]
    assert served.state() == state
    served.wait_for_log("activate canceled because another transition arrived")
    assert NO_FILE not in served.status().message
    assert all(runtime.is_closed for runtime in prepare.runtimes)


def test_an_activate_of_an_earlier_configuration_is_canceled(
    served: ServedNode, prepare: Preparations
) -> None:
    earlier = begin_loading(served, prepare)
    assert served.transition("cleanup")
    assert served.transition("configure")
    later = served.begin_transition("activate")
    assert finish_loading(served, prepare, earlier, later) == [False, True]
    assert [runtime.is_closed for runtime in prepare.runtimes] == [True, False]


@pytest.mark.parametrize("refusal", ["", NO_FILE], ids=["a good path", "a wrong path"])
def test_settings_changed_while_loading_are_the_ones_that_run(
    served: ServedNode, prepare: Preparations, refusal: str
) -> None:
    prepare.refusal = refusal
    activation = begin_loading(served, prepare)
    prepare.on_refusal = lambda: setattr(prepare, "refusal", "")
    assert served.set(weights="/such.pt") == (True, "")
    assert finish_loading(served, prepare, activation) == [True]
    assert [runtime.is_closed for runtime in prepare.runtimes] == [True, False][bool(refusal) :]
    assert class_ids_of(served.detect()) == ["cat"]


def test_activate_refuses_a_class_that_the_model_does_not_have(
    served: ServedNode, prepare: Preparations
) -> None:
    assert served.set(classes=["dgo"], class_thresholds=["cow: 0.5"]) == (True, "")
    served.bring_to("inactive")
    assert not served.transition("activate")
    for problem in ("classes: 'dgo' is not a class of the model", "class_thresholds: 'cow' is not"):
        assert problem in served.status().message
    assert served.state() == "inactive"
    assert prepare.running.is_closed


@pytest.mark.parametrize("state", ["inactive", "active"])
def test_a_device_that_is_lost_while_a_model_loads_ends_the_node(
    served: ServedNode, prepare: Preparations, state: str
) -> None:
    served.bring_to(state)
    prepare.refusal_type, prepare.refusal = DeviceLostError, "torch failed on cuda:0"
    answered = served.transition("activate") if state == "inactive" else served.set(image_size=320)[0]
    assert not answered
    assert served.node.exit_code == EXIT_DEVICE_LOST
    served.wait_for_log("exiting (code 3) because the device is lost: torch failed on cuda:0")
