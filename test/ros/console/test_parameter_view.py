"""Parameters as the page shows them, from what the node itself tells, and values as ROS takes them."""

from __future__ import annotations

import json
from typing import Any

import pytest
from rcl_interfaces.msg import (
    FloatingPointRange,
    ParameterDescriptor,
    ParameterType,
    ParameterValue,
)
from rclpy.parameter import Parameter

from yolov5_lifecycle.ros.console.parameter_view import (
    ParameterView,
    ValueRefusedError,
    parameter_message,
    plain_value,
    shown_values,
)
from yolov5_lifecycle.ros.parameters.declaration import unset_descriptor
from yolov5_lifecycle.settings.schema import Setting
from yolov5_lifecycle.settings.settings import SETTINGS, SETTINGS_BY_NAME

TYPES = {bool: "bool", int: "integer", float: "double", str: "string", tuple: "string_array"}


def view_of(setting: Setting) -> dict[str, Any]:
    view = ParameterView.of(unset_descriptor(setting))
    assert view is not None
    return view.as_json(None)


@pytest.mark.parametrize("setting", SETTINGS, ids=lambda setting: setting.name)
def test_a_descriptor_tells_default_choices_kind_of_change_and_scope(setting: Setting) -> None:
    shown = view_of(setting)
    default = list(setting.default) if isinstance(setting.default, tuple) else setting.default
    assert shown["name"] == setting.name
    assert shown["type"] == TYPES[setting.type]
    assert shown["default"] == default
    assert shown["choices"] == (list(setting.choices) or None)
    assert shown["constraints"] == setting.allowed
    assert setting.change.value.replace("-", " ").startswith(shown["change"] + ":")
    assert shown["per_camera"] is setting.per_camera
    json.dumps(shown, allow_nan=False)


def test_a_range_has_its_step() -> None:
    assert view_of(SETTINGS_BY_NAME["image_size"])["range"] == {"from": 64, "to": 4096, "step": 32}
    assert view_of(SETTINGS_BY_NAME["iou_threshold"])["range"] == {"from": 0.0, "to": 1.0, "step": 0.0}
    assert view_of(SETTINGS_BY_NAME["lazy"])["range"] is None


def test_a_parameter_that_is_no_setting_is_not_shown() -> None:
    assert ParameterView.of(ParameterDescriptor(name="use_sim_time")) is None


def test_an_unreadable_range_is_left_out() -> None:
    descriptor = ParameterDescriptor(
        name="gain",
        type=ParameterType.PARAMETER_DOUBLE,
        additional_constraints="a number; default 1.0; live: now",
        floating_point_range=[FloatingPointRange(from_value=float("nan"), to_value=1.0)],
    )
    view = ParameterView.of(descriptor)
    assert view is not None
    shown = view.as_json(0.5)
    assert (shown["default"], shown["range"], shown["change"]) == (1.0, None, "live")


VIEWS = {setting.name: ParameterView.of(unset_descriptor(setting)) for setting in SETTINGS}
KNOWN = {name: view for name, view in VIEWS.items() if view is not None}


@pytest.mark.parametrize(
    ("name", "value"),
    [
        pytest.param("lazy", False, id="bool"),
        pytest.param("max_detections", 3, id="integer"),
        pytest.param("max_rate", 2.5, id="double"),
        pytest.param("device", "cpu", id="string"),
        pytest.param("classes", [], id="empty list"),
        pytest.param("classes", ["cat", "Ärger <b>"], id="list"),
        pytest.param("front.max_rate", 5, id="unknown integer"),
        pytest.param("front.lazy", True, id="unknown bool"),
    ],
)
def test_a_value_arrives_as_it_was_sent(name: str, value: object) -> None:
    message = parameter_message(name, value, KNOWN)
    assert message.name == name
    assert plain_value(message.value) == value


def test_an_integer_is_a_number() -> None:
    assert parameter_message("max_rate", 2, KNOWN).value.double_value == 2.0


def test_null_deletes() -> None:
    assert parameter_message("front.max_rate", None, KNOWN).value.type == ParameterType.PARAMETER_NOT_SET


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [
        pytest.param("lazy", 1, "true or false", id="number for bool"),
        pytest.param("max_detections", 2.5, "an integer", id="fraction"),
        pytest.param("max_detections", True, "an integer", id="bool for integer"),
        pytest.param("max_detections", 2**63, "an integer", id="65 bits"),
        pytest.param("max_rate", "fast", "a number", id="string for number"),
        pytest.param("max_rate", 10**400, "a number", id="beyond a double"),
        pytest.param("device", 0, "a string", id="number for string"),
        pytest.param("device", "cpu\0", "a string", id="NUL"),
        pytest.param("device", "\ud800", "a string", id="half a character"),
        pytest.param("classes", "cat", "a list of strings", id="string for list"),
        pytest.param("classes", ["cat", 1], "a list of strings", id="number in list"),
        pytest.param("unknown", {}, "a list of strings", id="object"),
    ],
)
def test_a_value_of_another_type_is_refused_in_words(name: str, value: object, expected: str) -> None:
    with pytest.raises(ValueRefusedError, match=f"{name}: expected {expected}, found "):
        parameter_message(name, value, KNOWN)


@pytest.mark.parametrize("name", ["max_rate\0", "\ud800"], ids=["NUL", "half a character"])
def test_a_name_that_ros_cannot_send_is_refused(name: str) -> None:
    with pytest.raises(ValueRefusedError, match="expected the name of a parameter"):
        parameter_message(name, 1, KNOWN)


@pytest.mark.parametrize(
    "value",
    [
        pytest.param(ParameterValue(), id="not set"),
        pytest.param(
            ParameterValue(type=ParameterType.PARAMETER_DOUBLE, double_value=float("inf")), id="infinity"
        ),
        pytest.param(
            ParameterValue(type=ParameterType.PARAMETER_BYTE_ARRAY, byte_array_value=[b"a"]), id="bytes"
        ),
        pytest.param(
            ParameterValue(type=ParameterType.PARAMETER_DOUBLE_ARRAY, double_array_value=[float("nan")]),
            id="list of numbers",
        ),
        pytest.param(ParameterValue(type=200), id="unknown type"),
    ],
)
def test_a_value_that_no_setting_can_have_is_shown_as_unknown(value: ParameterValue) -> None:
    assert plain_value(value) is None


@pytest.mark.parametrize(
    ("name", "value"),
    [
        pytest.param("classes", 5, id="integer for list"),
        pytest.param("max_rate", "fast", id="string for number"),
        pytest.param("lazy", ["yes"], id="list for bool"),
    ],
)
def test_a_value_of_another_type_is_not_shown(name: str, value: object) -> None:
    shown = KNOWN[name].as_json(value)
    assert (shown["value"], shown["is_shown"]) == (None, False)


def test_what_is_not_set_differs_from_what_is_not_shown() -> None:
    values = {
        "classes": ParameterValue(),
        "weights": ParameterValue(type=ParameterType.PARAMETER_BYTE_ARRAY, byte_array_value=[b"a"]),
    }
    assert shown_values(values) == {"classes": None}
    assert KNOWN["classes"].as_json(None)["is_shown"] is True
    assert KNOWN["classes"].as_json(None, is_shown=False)["is_shown"] is False


@pytest.mark.parametrize(
    "default", ["{", "NaN", "1e999", "[" * 4_000, '"fast"'], ids=["syntax", "NaN", "large", "deep", "type"]
)
def test_a_default_that_is_no_value_of_its_type_is_left_out(default: str) -> None:
    descriptor = ParameterDescriptor(
        name="gain",
        type=ParameterType.PARAMETER_DOUBLE,
        additional_constraints=f"a number; default {default}; live: now",
    )
    view = ParameterView.of(descriptor)
    assert view is not None
    assert view.as_json(0.5)["default"] is None


@pytest.mark.parametrize(
    ("value", "shown"),
    [
        pytest.param(Parameter("a", value="\u202eexe.tp\n"), "?exe.tp?", id="direction of text"),
        pytest.param(Parameter("a", value=["fr\u200font", "a  b"]), ["fr?ont", "a  b"], id="list"),
    ],
)
def test_a_value_is_shown_printable(value: Parameter, shown: object) -> None:
    assert plain_value(value.to_parameter_msg().value) == shown


@pytest.mark.parametrize(
    "value", [["x" * 4_000] * 200, [""] * 600_000, "x" * 600_000], ids=["texts", "entries", "text"]
)
def test_values_beyond_what_all_may_have_are_not_shown(value: object) -> None:
    large = Parameter("a", value=value).to_parameter_msg().value
    small = Parameter("a", value=1).to_parameter_msg().value
    assert [*shown_values({"first": large, "second": large, "third": small})] == ["first", "third"]
