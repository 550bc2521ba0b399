"""What the page shows of messages and parameters of detectors, whatever they contain, and what ROS takes."""

from __future__ import annotations

import json

import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rcl_interfaces.msg import Log, ParameterValue
from rclpy.parameter import Parameter
from vision_msgs.msg import LabelInfo, VisionClass

from yolov5_lifecycle.models.class_names import MAX_NAME_LENGTH, class_names_of
from yolov5_lifecycle.ros.console import views
from yolov5_lifecycle.ros.console.views import (
    line_of,
    parameter_message,
    parameters_as_json,
    plain_value,
    statuses_of,
)
from yolov5_lifecycle.ros.parameters.declaration import parameter_of
from yolov5_lifecycle.settings.settings import SETTINGS

MANY = 20_000
TYPES = {bool: "bool", int: "integer", float: "double", str: "string", tuple: "string_array"}


@pytest.mark.parametrize(
    ("value", "number"), [("1.5", 1.5), ("", None), ("many", None), ("inf", None), ("1e999", None)]
)
def test_a_value_is_a_finite_number_or_none(value: str, number: float | None) -> None:
    status = DiagnosticStatus(name="yolov5: front", values=[KeyValue(key="rate Hz", value=value)])
    (view,) = statuses_of(DiagnosticArray(status=[status]))
    assert (view.number("rate Hz"), view.number("other")) == (number, None)


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


def shown(name: str, value: ParameterValue) -> dict[str, object]:
    """What a page receives of the parameter."""
    return parameters_as_json({name: value})[name]


def value_of(name: str, value: object) -> ParameterValue:
    return Parameter(name, value=value).to_parameter_msg().value


def test_a_setting_is_shown_with_type_default_choices_range_and_kind_of_change() -> None:
    for setting in SETTINGS:
        default = list(setting.default) if isinstance(setting.default, tuple) else setting.default
        value = parameter_of(setting, setting.default).to_parameter_msg().value
        found = json.loads(json.dumps(shown(setting.name, value), allow_nan=False))
        assert (found["name"], found["type"]) == (setting.name, TYPES[setting.type])
        assert (found["value"], found["is_shown"], found["default"]) == (default, True, default)
        assert found["choices"] == (list(setting.choices) or None)
        assert setting.change.value.startswith(f"{found['change'].replace('_', '-')}:")
    ranges = [shown(name, ParameterValue())["range"] for name in ("image_size", "iou_threshold", "lazy")]
    assert ranges == [{"from": 64, "to": 4096, "step": 32}, {"from": 0.0, "to": 1.0, "step": 0}, None]
    override = shown("front.max_rate", value_of("front.max_rate", 5.0))
    assert (override["value"], override["type"]) == (5.0, "double")
    others = {name: ParameterValue() for name in ("use_sim_time", "front.device", "a b.max_rate")}
    assert parameters_as_json(others) == {}


@pytest.mark.parametrize(
    ("name", "value"),
    [
        pytest.param("lazy", False, id="bool"),
        pytest.param("max_detections", 3, id="integer"),
        pytest.param("max_rate", 2.5, id="double"),
        pytest.param("device", "cpu", id="string"),
        pytest.param("classes", [], id="empty list"),
        pytest.param("classes", ["cat", "Ärger <b>"], id="list"),
        pytest.param("front.max_rate", None, id="deleted"),
    ],
)
def test_a_value_arrives_as_it_was_sent(name: str, value: object) -> None:
    message = parameter_message(name, value)
    assert (message.name, plain_value(message.value)) == (name, value)


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [
        pytest.param("max_detections", 2**63, "true, false", id="65 bits"),
        pytest.param("max_rate", 10**400, "true, false", id="beyond a double"),
        pytest.param("device", "cpu\0", "true, false", id="NUL"),
        pytest.param("device", "\ud800", "true, false", id="half a character"),
        pytest.param("classes", ["cat", 1], "true, false", id="number in list"),
        pytest.param("classes", ["\ud800"], "true, false", id="half a character in list"),
        pytest.param("unknown", {}, "true, false", id="object"),
        pytest.param("\ud800", 1, "the name of a parameter", id="name"),
    ],
)
def test_a_value_that_no_parameter_can_have_is_refused_in_words(
    name: str, value: object, expected: str
) -> None:
    with pytest.raises(ValueError, match=f": expected {expected}"):
        parameter_message(name, value)


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
    found = shown(name, value_of(name, value))
    assert (found["value"], found["is_shown"]) == (None, False)


def test_what_is_not_set_differs_from_what_is_not_shown() -> None:
    found = shown("classes", ParameterValue())
    assert (found["value"], found["is_shown"]) == (None, True)


def test_a_value_is_shown_printable() -> None:
    values = [Parameter("a", value=value) for value in ("\u202eexe.tp\n", ["fr\u200font", "a  b"])]
    assert [plain_value(value.to_parameter_msg().value) for value in values] == [
        "?exe.tp?",
        ["fr?ont", "a  b"],
    ]


@pytest.mark.parametrize(
    ("first", "second", "value"),
    [
        pytest.param("classes", "regions", ["x" * 4_000] * 200, id="texts"),
        pytest.param("classes", "regions", [""] * 600_000, id="entries"),
        pytest.param("weights", "device", "x" * 600_000, id="text"),
    ],
)
def test_values_beyond_what_all_may_have_are_not_shown(first: str, second: str, value: object) -> None:
    large = value_of(first, value)
    found = parameters_as_json({first: large, second: large, "max_rate": value_of("max_rate", 1.0)})
    assert [name for name, each in found.items() if each["is_shown"]] == [first, "max_rate"]
