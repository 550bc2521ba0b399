"""Activate loads the model in the background, and what may happen meanwhile."""

from __future__ import annotations

from typing import Any

import pytest
from support.preparations import Preparations
from support.served_node import PATIENCE_S, ServedNode, class_ids_of

from yolov5_lifecycle.ros.detector.node import EXIT_DEVICE_LOST
from yolov5_lifecycle.runtimes.runtime import DeviceLostError


def begin_loading(served: ServedNode, prepare: Preparations) -> Any:
    """Ask an inactive node to activate, which waits for `prepare.gate`; the future of the answer."""
    served.bring_to("inactive")
    prepare.gate.clear()
    answer = served.begin_transition("activate")
    assert prepare.begun.acquire(timeout=PATIENCE_S)
    return answer


def test_activate_that_cannot_load_says_why_and_stays_inactive(
    served: ServedNode, prepare: Preparations
) -> None:
    prepare.refusal = "/no/such.pt: there is no such file"
    served.bring_to("inactive")
    assert not served.transition("activate")
    assert served.state() == "inactive"
    assert "/no/such.pt" in served.status().message
    prepare.refusal = ""
    assert served.transition("activate")
    assert "/no/such.pt" not in served.status().message


def test_services_answer_while_the_model_loads(served: ServedNode, prepare: Preparations) -> None:
    activation = begin_loading(served, prepare)
    assert served.state() == "inactive"
    assert served.get("confidence_threshold") == 0.25
    assert not activation.done()
    prepare.gate.set()
    served.wait_for(activation.done, "activate")
    assert activation.result().success
    assert served.state() == "active"


def test_a_second_activate_while_loading_is_refused(served: ServedNode, prepare: Preparations) -> None:
    first = begin_loading(served, prepare)
    assert not served.transition("activate")
    prepare.gate.set()
    served.wait_for(first.done, "the first activate")
    assert first.result().success
    assert len(prepare.runtimes) == 1


@pytest.mark.parametrize(("label", "state"), [("cleanup", "unconfigured"), ("shutdown", "finalized")])
def test_another_transition_wins_over_a_loading_activate(
    served: ServedNode, prepare: Preparations, label: str, state: str
) -> None:
    activation = begin_loading(served, prepare)
    assert served.transition(label)
    prepare.gate.set()
    served.wait_for(activation.done, "activate")
    assert not activation.result().success
    assert served.state() == state
    assert all(runtime.is_closed for runtime in prepare.runtimes)


def test_cleanup_wins_over_an_activate_whose_model_cannot_be_loaded(
    served: ServedNode, prepare: Preparations
) -> None:
    prepare.refusal = "/no/such.pt: there is no such file"
    activation = begin_loading(served, prepare)
    assert served.transition("cleanup")
    prepare.gate.set()
    served.wait_for(activation.done, "activate")
    assert not activation.result().success
    served.wait_for_log("activate canceled because another transition arrived")
    assert "/no/such.pt" not in served.status().message


def test_an_activate_of_an_earlier_configuration_is_canceled(
    served: ServedNode, prepare: Preparations
) -> None:
    earlier = begin_loading(served, prepare)
    assert served.transition("cleanup")
    assert served.transition("configure")
    later = served.begin_transition("activate")
    prepare.gate.set()
    served.wait_for(lambda: earlier.done() and later.done(), "both answers")
    assert (earlier.result().success, later.result().success) == (False, True)
    assert [runtime.is_closed for runtime in prepare.runtimes] == [True, False]


def test_a_path_corrected_while_the_wrong_one_is_loaded_is_loaded(
    served: ServedNode, prepare: Preparations
) -> None:
    prepare.refusal = "/no/such.pt: there is no such file"
    activation = begin_loading(served, prepare)
    prepare.on_refusal = lambda: setattr(prepare, "refusal", "")
    assert served.set(weights="/such.pt") == (True, "")
    prepare.gate.set()
    served.wait_for(activation.done, "activate")
    assert activation.result().success


def test_settings_changed_while_loading_are_the_ones_that_run(
    served: ServedNode, prepare: Preparations
) -> None:
    activation = begin_loading(served, prepare)
    assert served.set(image_size=320) == (True, "")
    prepare.gate.set()
    served.wait_for(activation.done, "activate")
    assert [runtime.is_closed for runtime in prepare.runtimes] == [True, False]
    assert class_ids_of(served.detect()) == ["cat"]


@pytest.mark.parametrize(
    ("entry", "problem"),
    [
        pytest.param("dgo", "Did you mean 'dog'?", id="typo"),
        pytest.param("9" * 200, "is out of range: the model has 2 classes", id="index-of-200-digits"),
    ],
)
def test_activate_refuses_a_class_that_the_model_does_not_have(
    served: ServedNode, prepare: Preparations, entry: str, problem: str
) -> None:
    assert served.set(classes=[entry]) == (True, "")
    served.bring_to("inactive")
    assert not served.transition("activate")
    assert problem in served.status().message
    assert served.state() == "inactive"
    assert prepare.running.is_closed


@pytest.mark.parametrize("state", ["inactive", "active"])
def test_a_device_that_is_lost_while_a_model_loads_ends_the_node(
    served: ServedNode, prepare: Preparations, state: str
) -> None:
    served.bring_to(state)
    prepare.refusal_type = DeviceLostError
    prepare.refusal = "torch failed on cuda:0"
    answered = served.transition("activate") if state == "inactive" else served.set(image_size=320)[0]
    assert not answered
    assert served.node.exit_code == EXIT_DEVICE_LOST
    served.wait_for_log("exiting (code 3) because the device is lost: torch failed on cuda:0")
