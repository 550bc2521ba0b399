"""Messages that are read field by field, compared with what rclpy serializes."""

from __future__ import annotations

import pytest
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rcl_interfaces.msg import Log
from rclpy.serialization import serialize_message
from vision_msgs.msg import LabelInfo, VisionClass

from yolov5_lifecycle.models.class_names import MAX_NAME_LENGTH, class_names_of
from yolov5_lifecycle.ros.console.camera_view import read_statuses
from yolov5_lifecycle.ros.console.class_names import read_class_names
from yolov5_lifecycle.ros.console.log_view import read_log
from yolov5_lifecycle.ros.console.serialized_message import UnreadableError
from yolov5_lifecycle.ros.detector.session import label_info

LOG = serialize_message(Log(name="robot.eyes", msg="first\nsecond\n\u202ethird", level=40))
LABELS = serialize_message(
    LabelInfo(class_map=[VisionClass(class_id=number, class_name="x" * number) for number in range(9)])
)
STATUSES = serialize_message(
    DiagnosticArray(
        status=[
            DiagnosticStatus(
                name=f"eyes: {name}",
                hardware_id="/eyes",
                level=b"\x02",
                message="a" * length,
                values=[KeyValue(key="k" * length, value="v")] * 2,
            )
            for length, name in enumerate(("detection", "front", "rear"))
        ]
    )
)


def test_a_line_of_the_log_keeps_its_line_breaks() -> None:
    logger, line = read_log(LOG)
    assert (logger, line.level) == ("robot.eyes", "error")
    assert line.text == "first\n  second\n  ?third"


def test_a_long_line_ends_with_its_length() -> None:
    _, line = read_log(serialize_message(Log(msg="x" * 1_000_000)))
    assert len(line.text) == 4_000
    assert line.text.endswith("... (1000000 bytes)")


def test_every_class_name_is_read() -> None:
    assert read_class_names(LABELS) == ["x" * number for number in range(9)]


def test_a_name_of_any_kind_is_shown_as_the_model_has_it() -> None:
    """So that a class that is chosen on the page is one of the model."""
    family, persian, longest = "👩\u200d👩\u200d👧", "می\u200cشود", "行" * MAX_NAME_LENGTH
    names = [7, True, "", "a\u00a0b\tc", "\x1b[2J", "c\u200dat", "\ud800", family, persian, longest]
    texts = class_names_of(names, len(names), len(names))
    labels = label_info(texts, 0.25, Time())
    assert tuple(read_class_names(serialize_message(labels))) == texts


def test_every_status_is_read() -> None:
    found = list(read_statuses(STATUSES))
    assert {node for node, _ in found} == {"/eyes"}
    assert [status.name for _, status in found] == ["detection", "front", "rear"]
    assert [status.message for _, status in found] == ["", "a", "aa"]
    assert found[2][1].values == {"kk": "v"}


@pytest.mark.parametrize("length", range(0, 60, 3))
def test_a_message_that_ends_too_early_is_refused(length: int) -> None:
    with pytest.raises(UnreadableError):
        read_class_names(LABELS[:length])
    with pytest.raises(UnreadableError):
        list(read_statuses(STATUSES[:length]))
    with pytest.raises(UnreadableError):
        read_log(LOG[: length // 2])
