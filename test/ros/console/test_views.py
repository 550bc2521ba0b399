"""What the page shows of the messages of detectors, which may have any content and size."""

from __future__ import annotations

import pytest
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rcl_interfaces.msg import Log
from vision_msgs.msg import LabelInfo, VisionClass

from yolov5_lifecycle.models.class_names import MAX_NAME_LENGTH, class_names_of
from yolov5_lifecycle.ros.console import views
from yolov5_lifecycle.ros.console.views import StatusView, line_of, statuses_of
from yolov5_lifecycle.ros.detector.session import label_info

MANY = 20_000


def status_with(key: str, value: str) -> StatusView:
    status = DiagnosticStatus(name="yolov5: front", values=[KeyValue(key=key, value=value)])
    (view,) = statuses_of(DiagnosticArray(status=[status]))
    return view


@pytest.mark.parametrize(
    ("key", "value", "balance"),
    [
        pytest.param("frames detected", "12", {"detected": 12}, id="number"),
        pytest.param("frames detected", "9" * 18, {"detected": 10**18 - 1}, id="18 digits"),
        pytest.param("frames detected", "9" * 19, {}, id="19 digits"),
        pytest.param("frames detected", "9" * 4_500, {}, id="more digits than Python converts"),
        pytest.param("frames detected", "-1", {}, id="negative"),
        pytest.param("frames detected", "١٢", {}, id="digits of another script"),
        pytest.param("frames lost", "3", {}, id="sent but not received"),
        pytest.param("rate Hz", "3", {}, id="no number of frames"),
    ],
)
def test_the_balance_has_the_numbers_of_frames(key: str, value: str, balance: dict[str, int]) -> None:
    assert status_with(key, value).balance == balance


def test_the_statuses_of_one_node_are_shown() -> None:
    names = ("detection", "front", "rear")
    statuses = [DiagnosticStatus(name=f"eyes: {name}", hardware_id="/eyes", level=b"\x02") for name in names]
    other = DiagnosticStatus(name="ears: front", hardware_id="/ears")
    found = statuses_of(DiagnosticArray(status=[statuses[0], other, *statuses[1:]]))
    assert [(status.name, status.level) for status in found] == [(name, 2) for name in names]


def test_of_many_and_long_values_the_beginning_is_shown() -> None:
    long = KeyValue(key="a" * MANY, value="b" * MANY)
    values = [long, *(KeyValue(key=str(number), value="") for number in range(MANY))]
    status = DiagnosticStatus(message="c" * MANY, values=values, level=b"\xff")
    (shown,) = statuses_of(DiagnosticArray(status=[status]))
    (key, value), *_ = shown.values.items()
    assert (len(key), len(value), len(shown.message), len(shown.values)) == (200, 5_000, 5_000, 100)
    assert shown.level == views.STALE
    assert len(statuses_of(DiagnosticArray(status=[DiagnosticStatus()] * MANY))) < 20


def test_a_line_of_the_log_keeps_its_line_breaks() -> None:
    line = line_of(Log(msg="first\nsecond\n\u202ethird", level=40))
    assert (line.level, line.text) == ("error", "first\n  second\n  ?third")


def test_a_long_line_ends_with_its_length() -> None:
    line = line_of(Log(msg="x" * 1_000_000))
    assert len(line.text) == 4_000
    assert line.text.endswith("... (1000000 characters)")


def test_a_name_of_any_kind_is_shown_as_the_model_has_it() -> None:
    """So that a class that is chosen on the page is one of the model."""
    family, persian, longest = "👩\u200d👩\u200d👧", "می\u200cشود", "行" * MAX_NAME_LENGTH
    names = [7, True, "", "a\u00a0b\tc", "\x1b[2J", "c\u200dat", "\ud800", family, persian, longest]
    texts = class_names_of(names, len(names), len(names))
    assert tuple(views.class_names_of(label_info(texts, 0.25, Time()))) == texts


def test_of_many_and_long_class_names_the_beginning_is_shown() -> None:
    shown = views.class_names_of(LabelInfo(class_map=[VisionClass(class_name="x" * MANY)] * MANY))
    assert (len(shown), len(shown[0])) == (10_000, 200)
