"""Requests to the parameter services: whatever is sent, each is validated once, and its work is bounded."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import pytest
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.msg import ParameterValue
from rcl_interfaces.srv import DescribeParameters, GetParameters, GetParameterTypes, ListParameters
from support.preparations import Preparations
from support.served_node import ServedNode, class_ids_of, messages_of

from yolov5_lifecycle.ros.detector.session import Session
from yolov5_lifecycle.ros.parameters import settings_parameters
from yolov5_lifecycle.ros.services import MAX_ITEMS, MAX_REASON
from yolov5_lifecycle.settings.settings import Settings, validated


def unknown(count: int) -> list[ParameterMessage]:
    """Parameters whose names resemble that of a setting."""
    value = ParameterValue(type=3, double_value=0.5)
    return [ParameterMessage(name=f"confidence_treshold{number}", value=value) for number in range(count)]


def test_a_change_is_validated_once_and_many_bad_values_once_for_each_and_once_together(
    served: ServedNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[Mapping[str, object]] = []

    def validate(values: Mapping[str, object]) -> Settings:
        seen.append(values)
        return validated(values)

    monkeypatch.setattr(settings_parameters, "validated", validate)
    assert served.set(cameras=["front", "rear"]) == (True, "")
    served.bring_to("active")
    seen.clear()
    (result,) = served.set_one_by_one(messages_of(confidence_threshold=0.5))
    assert result.successful
    assert served.set(**{"front.max_rate": 2.0, "rear.lazy": False}) == (True, "")
    assert served.set(**{"front.max_rate": None}) == (True, "")
    assert served.set(image_size=320, confidence_threshold=0.5) == (True, "")
    assert len(seen) == 4
    results = served.set_one_by_one(messages_of(max_rate=-1.0) * 100)
    assert [result.successful for result in results] == [False] * 100
    assert len(seen) - 4 <= 101


def test_a_request_with_too_many_parameters_is_refused_as_a_whole(served: ServedNode) -> None:
    done, reason = served.set_messages(unknown(MAX_ITEMS))
    assert not done
    assert len(reason) < MAX_REASON + 50
    count = MAX_ITEMS + 1
    asked = messages_of(lazy=False) + unknown(count - 1)
    done, reason = served.set_messages(asked)
    assert not done
    assert f"{count} items in one request; at most {MAX_ITEMS} are accepted" in reason
    results = served.set_one_by_one(asked)
    assert [result.reason for result in results] == [reason] * count
    assert served.get("lazy") is True


def test_a_request_about_too_many_names_is_answered_with_nothing(served: ServedNode) -> None:
    names = ["lazy"] * 80_000
    assert not served.call("get_parameters", GetParameters.Request(names=names)).values
    assert not served.call("get_parameter_types", GetParameterTypes.Request(names=names)).types
    assert not served.call("describe_parameters", DescribeParameters.Request(names=names)).descriptors
    assert not served.call("list_parameters", ListParameters.Request(prefixes=names)).result.names
    served.wait_for_log(f"80000 items in one request; at most {MAX_ITEMS} are accepted")


def test_a_change_that_cannot_take_effect_leaves_nothing_behind(
    active: ServedNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    apply, applied = Session.apply, list[float]()

    def fail(session: Session, settings: Settings, preparation: Any) -> None:
        applied.append(settings.confidence_threshold)
        if settings.confidence_threshold > 0.5:
            raise RuntimeError("the subscription failed")
        apply(session, settings, preparation)

    monkeypatch.setattr(Session, "apply", fail)
    (result,) = active.set_one_by_one(messages_of(confidence_threshold=0.75))
    assert not result.successful
    assert "the subscription failed" in result.reason
    assert active.get("confidence_threshold") == 0.25
    assert applied == [0.75, 0.25]
    assert active.node._settings.settings() == Settings()


# Reloads


def test_while_a_model_is_loaded_frames_are_detected_and_another_model_is_refused(
    active: ServedNode, prepare: Preparations
) -> None:
    prepare.gate.clear()
    prepared = len(prepare.sizes_hw)
    reload = active.begin_set(image_size=320)
    active.wait_for(lambda: len(prepare.sizes_hw) > prepared, "the reload to begin")
    reason = active.refusal(image_size=352)
    assert reason.startswith("another model is being loaded: set this again once that has been answered")
    assert active.set(confidence_threshold=0.5) == (True, "")
    assert class_ids_of(active.detect()) == ["cat"]
    assert (active.state(), active.get("image_size"), reload.done()) == ("active", 640, False)
    prepare.gate.set()
    active.wait_for(reload.done, "the answer")
    assert reload.result().result.successful
    settings = active.node._settings.settings()
    assert (settings.image_size, settings.confidence_threshold) == (320, 0.5)
    assert active.set(image_size=352) == (True, "")
    assert [runtime.is_closed for runtime in prepare.runtimes] == [True, True, False]


def test_leaving_active_wins_over_a_reload_and_the_next_one_is_carried_out(
    active: ServedNode, prepare: Preparations
) -> None:
    prepare.gate.clear()
    prepared = len(prepare.sizes_hw)
    reload = active.begin_set(image_size=320)
    active.wait_for(lambda: len(prepare.sizes_hw) > prepared, "the reload to begin")
    assert active.transition("deactivate")
    prepare.gate.set()
    active.wait_for(reload.done, "the answer")
    assert not reload.result().result.successful
    assert "left the active state" in reload.result().result.reason
    assert active.get("image_size") == 640
    assert all(runtime.is_closed for runtime in prepare.runtimes)
    assert active.transition("activate")
    assert active.set(image_size=384) == (True, "")


def test_a_loaded_file_with_new_classes_and_new_weights_says_how_to_set_both(
    active: ServedNode, prepare: Preparations
) -> None:
    assert active.set(classes=["cat"], class_thresholds=["cat: 0.5"]) == (True, "")
    prepare.class_names = ("star", "circle")
    asked = messages_of(weights="/other.pt", classes=["star"], class_thresholds=["star: 0.5"])
    of_weights, of_classes, of_thresholds = active.set_one_by_one(asked)
    assert "class_thresholds: 'cat' is not a class of the model" in of_weights.reason
    assert "`classes`, `class_thresholds` still names classes of the running model" in of_weights.reason
    assert "'star' is not a class of the model" in of_classes.reason
    assert "If it depends on another parameter of this request: set both together" in of_classes.reason
    assert not of_thresholds.successful
    assert class_ids_of(active.detect()) == ["cat"]
    assert active.set_messages(asked) == (True, "")
    assert active.label_info().class_map[0].class_name == "star"
