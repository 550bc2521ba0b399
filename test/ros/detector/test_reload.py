"""A model is replaced while the node is active."""

from __future__ import annotations

import pytest
from support.preparations import Preparations, prediction
from support.served_node import PATIENCE_S, ServedNode, class_ids_of, image

from yolov5_lifecycle.detection.detector import USUAL_SOURCE_HW


def test_a_reload_swaps_the_model_and_frees_the_old_one(served: ServedNode, prepare: Preparations) -> None:
    served.bring_to("active")
    served.detect()
    assert served.set(image_size=320) == (True, "")
    old, new = prepare.runtimes
    assert old.is_closed
    assert not new.is_closed
    new.run = lambda: prediction("dog", 0.8)
    assert class_ids_of(served.detect()) == ["dog"]


def test_frames_are_detected_while_the_next_model_loads(served: ServedNode, prepare: Preparations) -> None:
    served.bring_to("active")
    prepare.gate.clear()
    change = served.begin_set(image_size=320)
    prepare.begun.acquire(timeout=PATIENCE_S)
    assert prepare.begun.acquire(timeout=PATIENCE_S)
    assert class_ids_of(served.detect()) == ["cat"]
    assert served.state() == "active"
    assert served.get("image_size") == 640
    assert not change.done()
    prepare.gate.set()
    served.wait_for(change.done, "the reload")
    assert change.result().result.successful
    assert served.get("image_size") == 320


def test_a_refused_reload_leaves_model_and_value_alone(served: ServedNode, prepare: Preparations) -> None:
    served.bring_to("active")
    prepare.refusal = "/broken.pt: this is no checkpoint"
    done, reason = served.set(weights="/broken.pt")
    assert not done
    assert "/broken.pt: this is no checkpoint" in reason
    assert served.get("weights") == ""
    assert class_ids_of(served.detect()) == ["cat"]
    assert not prepare.running.is_closed


def test_a_model_is_warmed_up_for_images_like_the_last_one(served: ServedNode, prepare: Preparations) -> None:
    served.bring_to("active")
    served.detect()
    assert served.set(image_size=320)[0]
    assert served.transition("deactivate")
    assert served.transition("activate")
    image_hw = image().height, image().width
    assert prepare.sizes_hw == [[USUAL_SOURCE_HW], [image_hw], [image_hw]]


def test_a_reload_is_logged(served: ServedNode, prepare: Preparations) -> None:
    served.bring_to("active")
    assert served.set(image_size=320)[0]
    served.wait_for_log("the model was replaced: weights /scripted.pt")
    prepare.refusal = "/no/such.pt: there is no such file"
    assert not served.set(image_size=416)[0]
    served.wait_for_log("the running model stays, its replacement was refused: /no/such.pt")


def test_a_reload_that_another_change_contradicts_is_refused_and_freed(
    served: ServedNode, prepare: Preparations
) -> None:
    served.bring_to("active")
    prepare.gate.clear()
    reload = served.begin_set(model_size="n6")  # needs multiples of 64
    assert prepare.begun.acquire(timeout=PATIENCE_S)
    other = served.begin_set(image_size=672)
    prepare.gate.set()
    served.wait_for(lambda: reload.done() and other.done(), "both answers")
    answers = [reload.result().result, other.result().result]
    assert sorted(answer.successful for answer in answers) == [False, True]
    assert sum(not runtime.is_closed for runtime in prepare.runtimes) == 1
    assert served.escaped == []


def test_an_unexpected_exception_in_a_reload_is_answered_and_logged(
    served: ServedNode, prepare: Preparations
) -> None:
    served.bring_to("active")
    prepare.refusal_type, prepare.refusal = KeyError, "surprise"
    assert served.set(image_size=320) == (False, "KeyError: 'surprise'")
    served.wait_for_log("unexpected KeyError in yolov5/set_parameters_atomically:\n  Traceback")
    assert class_ids_of(served.detect()) == ["cat"]


def test_concurrent_reloads_are_both_applied(served: ServedNode, prepare: Preparations) -> None:
    served.bring_to("active")
    changes = [served.begin_set(image_size=320), served.begin_set(weights="/other.pt")]
    for change in changes:
        served.wait_for(change.done, "both reloads")
        assert change.result().result.successful
    assert (served.get("image_size"), served.get("weights")) == (320, "/other.pt")
    assert [runtime.is_closed for runtime in prepare.runtimes[:-1]] == [True] * (len(prepare.runtimes) - 1)
    assert not prepare.running.is_closed


@pytest.mark.parametrize("label", ["deactivate", "shutdown"])
def test_leaving_active_wins_over_a_reload(served: ServedNode, prepare: Preparations, label: str) -> None:
    served.bring_to("active")
    prepare.gate.clear()
    change = served.begin_set(image_size=320)
    prepare.begun.acquire(timeout=PATIENCE_S)
    assert prepare.begun.acquire(timeout=PATIENCE_S)
    assert served.transition(label)
    prepare.gate.set()
    served.wait_for(change.done, "the reload")
    assert not change.result().result.successful
    assert "left the active state" in change.result().result.reason
    assert served.get("image_size") == 640
    assert all(runtime.is_closed for runtime in prepare.runtimes)


def test_several_reload_settings_at_once_load_one_model(served: ServedNode, prepare: Preparations) -> None:
    served.bring_to("active")
    assert served.set(image_size=320, weights="/other.pt", confidence_threshold=0.5) == (True, "")
    assert len(prepare.runtimes) == 2


def test_new_weights_without_the_class_of_a_threshold_are_refused_with_the_parameter_to_change(
    served: ServedNode, prepare: Preparations
) -> None:
    served.bring_to("active")
    assert served.set(class_thresholds=["cat: 0.5"]) == (True, "")
    prepare.class_names = ("star", "circle")
    done, reason = served.set(weights="/other.pt")
    assert not done
    assert "class_thresholds: 'cat' is not a class of the model" in reason
    assert "`class_thresholds` still names classes of the running model" in reason
    assert class_ids_of(served.detect()) == ["cat"]
