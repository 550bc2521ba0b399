"""Messages that are read field by field, compared with what rclpy serializes."""

from __future__ import annotations

import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rcl_interfaces.msg import Log
from rclpy.serialization import serialize_message
from vision_msgs.msg import LabelInfo, VisionClass

from yolov5_lifecycle.ros.console.camera_view import read_statuses
from yolov5_lifecycle.ros.console.class_names import read_class_names
from yolov5_lifecycle.ros.console.log_view import read_log
from yolov5_lifecycle.ros.console.serialized_message import UnreadableError

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
