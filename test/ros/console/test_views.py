"""What the page shows of messages and parameters of detectors, whatever they contain, and what ROS takes."""

from __future__ import annotations

import json

import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rcl_interfaces.msg import Log, ParameterDescriptor, ParameterType, ParameterValue
from rclpy.parameter import Parameter
from vision_msgs.msg import LabelInfo, VisionClass

from yolov5_lifecycle.models.class_names import MAX_NAME_LENGTH, class_names_of
from yolov5_lifecycle.ros.console import views
from yolov5_lifecycle.ros.console.parameter_view import (
    ParameterView,
    parameter_message,
    plain_value,
    shown_values,
)
from yolov5_lifecycle.ros.console.views import line_of, statuses_of
from yolov5_lifecycle.ros.parameters.declaration import unset_descriptor
from yolov5_lifecycle.settings.settings import SETTINGS

MANY = 20_000
TYPES = {bool: "bool", int: "integer", float: "double", str: "string", tuple: "string_array"}
FOUND = {setting.name: ParameterView.of(unset_descriptor(setting)) for setting in SETTINGS}
VIEWS = {name: view for name, view in FOUND.items() if view is not None}


@pytest.mark.parametrize(
    ("key", "value", "balance"),
    [
        pytest.param("frames detected", "9" * 18, {"detected": 10**18 - 1}, id="18 digits"),
        pytest.param("frames detected", "9" * 19, {}, id="19 digits"),
        pytest.param("frames detected", "-1", {}, id="negative"),
        pytest.param("frames detected", "١٢", {}, id="digits of another script"),
        pytest.param("frames lost", "3", {}, id="sent but not received"),
        pytest.param("rate Hz", "3", {}, id="no number of frames"),
    ],
)
def test_the_balance_has_the_numbers_of_frames(key: str, value: str, balance: dict[str, int]) -> None:
    status = DiagnosticStatus(name="yolov5: front", values=[KeyValue(key=key, value=value)])
    (view,) = statuses_of(DiagnosticArray(status=[status]))
    assert view.balance == balance


def test_the_statuses_of_one_node_are_shown() -> None:
    names = ("detection", "front", "rear")
    statuses = [DiagnosticStatus(name=f"eyes: {name}", hardware_id="/eyes", level=b"\x02") for name in names]
    other = DiagnosticStatus(name="ears: front", hardware_id="/ears")
    found = statuses_of(DiagnosticArray(status=[statuses[0], other, *statuses[1:]]))
    assert [(status.name, status.level) for status in found] == [(name, 2) for name in names]


def test_of_many_and_long_values_lines_and_names_the_beginning_is_shown() -> None:
    long = KeyValue(key="a" * MANY, value="b" * MANY)
    values = [long, *(KeyValue(key=str(number), value="") for number in range(MANY))]
    status = DiagnosticStatus(message="c" * MANY, values=values, level=b"\xff")
    (shown,) = statuses_of(DiagnosticArray(status=[status]))
    (key, value), *_ = shown.values.items()
    assert (len(key), len(value), len(shown.message), len(shown.values)) == (200, 5_000, 5_000, 100)
    assert shown.level == views.STALE
    assert len(statuses_of(DiagnosticArray(status=[DiagnosticStatus()] * MANY))) < 20
    line = line_of(Log(msg="x" * 1_000_000)).text
    assert len(line) == 4_000
    assert line.endswith("... (1000000 characters)")
    names = views.class_names_of(LabelInfo(class_map=[VisionClass(class_name="x" * 201)] * MANY))
    assert (len(names), len(names[0])) == (10_000, 200)


def test_a_line_of_the_log_keeps_its_line_breaks() -> None:
    line = line_of(Log(msg="first\nsecond\n\u202ethird", level=40))
    assert (line.level, line.text) == ("error", "first\n  second\n  ?third")


def test_a_name_of_any_kind_is_shown_as_the_model_has_it() -> None:
    """So that a class that is chosen on the page is one of the model."""
    family, persian, longest = "👩\u200d👩\u200d👧", "می\u200cشود", "行" * MAX_NAME_LENGTH
    names = [7, True, "", "a\u00a0b\tc", "\x1b[2J", "c\u200dat", "\ud800", family, persian, longest]
    texts = class_names_of(names, len(names), len(names))
    named = [VisionClass(class_id=index, class_name=name) for index, name in enumerate(texts)]
    labels = LabelInfo(class_map=named)
    assert tuple(views.class_names_of(labels)) == texts


def test_descriptors_tell_default_choices_range_kind_of_change_and_scope() -> None:
    for setting in SETTINGS:
        shown = VIEWS[setting.name].as_json(None)
        default = list(setting.default) if isinstance(setting.default, tuple) else setting.default
        assert (shown["name"], shown["type"]) == (setting.name, TYPES[setting.type])
        assert (shown["default"], shown["choices"]) == (default, list(setting.choices) or None)
        assert (shown["constraints"], shown["per_camera"]) == (setting.allowed, setting.per_camera)
        assert setting.change.value.replace("-", " ").startswith(f"{shown['change']}:")
        json.dumps(shown, allow_nan=False)
    ranges = [VIEWS[name].as_json(None)["range"] for name in ("image_size", "iou_threshold", "lazy")]
    assert ranges == [{"from": 64, "to": 4096, "step": 32}, {"from": 0.0, "to": 1.0, "step": 0.0}, None]
    assert ParameterView.of(ParameterDescriptor(name="use_sim_time")) is None


@pytest.mark.parametrize("default", ["{", "NaN", "1e999", '"fast"'], ids=["syntax", "NaN", "large", "type"])
def test_a_default_that_is_no_value_of_its_type_is_left_out(default: str) -> None:
    constraints = f"a number; default {default}; live: now"
    descriptor = ParameterDescriptor(
        name="gain", type=ParameterType.PARAMETER_DOUBLE, additional_constraints=constraints
    )
    view = ParameterView.of(descriptor)
    assert view is not None
    assert (view.as_json(0.5)["default"], view.change) == (None, "live")


@pytest.mark.parametrize(
    ("name", "value"),
    [
        pytest.param("lazy", False, id="bool"),
        pytest.param("max_detections", 3, id="integer"),
        pytest.param("max_rate", 2.5, id="double"),
        pytest.param("max_rate", 2, id="integer for double"),
        pytest.param("device", "cpu", id="string"),
        pytest.param("classes", [], id="empty list"),
        pytest.param("classes", ["cat", "Ärger <b>"], id="list"),
        pytest.param("front.max_rate", 5, id="unknown"),
        pytest.param("front.max_rate", None, id="deleted"),
    ],
)
def test_a_value_arrives_as_it_was_sent(name: str, value: object) -> None:
    message = parameter_message(name, value, VIEWS)
    assert (message.name, plain_value(message.value)) == (name, value)


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
        pytest.param("\ud800", 1, "the name of a parameter", id="name"),
    ],
)
def test_a_value_of_another_type_is_refused_in_words(name: str, value: object, expected: str) -> None:
    with pytest.raises(ValueError, match=f": expected {expected}"):
        parameter_message(name, value, VIEWS)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        pytest.param("max_rate", float("inf"), id="infinity"),
        pytest.param("classes", 5, id="integer for list"),
        pytest.param("lazy", ["yes"], id="list for bool"),
        pytest.param("classes", [0.5], id="list of numbers"),
        pytest.param("weights", [b"a"], id="bytes"),
    ],
)
def test_a_value_that_the_setting_cannot_have_is_not_shown(name: str, value: object) -> None:
    values = shown_values({name: Parameter(name, value=value).to_parameter_msg().value})
    shown = VIEWS[name].as_json(values.get(name), is_shown=name in values)
    assert (shown["value"], shown["is_shown"]) == (None, False)


def test_what_is_not_set_differs_from_what_is_not_shown() -> None:
    assert shown_values({"classes": ParameterValue()}) == {"classes": None}
    assert VIEWS["classes"].as_json(None)["is_shown"] is True


def test_a_value_is_shown_printable() -> None:
    values = [Parameter("a", value=value) for value in ("\u202eexe.tp\n", ["fr\u200font", "a  b"])]
    shown = [plain_value(value.to_parameter_msg().value) for value in values]
    assert shown == ["?exe.tp?", ["fr?ont", "a  b"]]


@pytest.mark.parametrize(
    "value", [["x" * 4_000] * 200, [""] * 600_000, "x" * 600_000], ids=["texts", "entries", "text"]
)
def test_values_beyond_what_all_may_have_are_not_shown(value: object) -> None:
    large = ParameterValue(type=ParameterType.PARAMETER_STRING_ARRAY, string_array_value=value)
    if isinstance(value, str):
        large = ParameterValue(type=ParameterType.PARAMETER_STRING, string_value=value)
    small = Parameter("a", value=1).to_parameter_msg().value
    assert [*shown_values({"first": large, "second": large, "third": small})] == ["first", "third"]
