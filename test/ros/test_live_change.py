"""The files that a live change of a parameter runs through are few, and listed in docs/architecture.md."""

from __future__ import annotations

import re
import sys
from collections.abc import Coroutine
from pathlib import Path
from types import FrameType
from typing import Any

import pytest
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from support.colcon_workspace import REPOSITORY
from support.preparations import Preparations
from support.served_node import ServedNode

import yolov5_lifecycle

MAX_FILES = 12
PACKAGE = Path(yolov5_lifecycle.__file__).parent


def listed_files() -> list[str]:
    """Files in the table of the section on a live change, from top to bottom."""
    text = (REPOSITORY / "docs" / "architecture.md").read_text()
    section = text.partition("\n## One live change of a parameter\n")[2].partition("\n## ")[0]
    return re.findall(r"^\| `([\w/.]+)` \|", section, re.MULTILINE)


def result_of(answer: Coroutine[Any, Any, Any]) -> Any:
    """Result of a callback that awaits nothing."""
    with pytest.raises(StopIteration) as end:
        answer.send(None)
    return end.value.value


def files_of_a_change(served: ServedNode, name: str, value: object) -> list[str]:
    """Files of this package in the order in which the service callback first calls a function in them."""
    files: dict[str, None] = {}

    def record(frame: FrameType, event: str, _: Any) -> None:
        if event == "call" and (path := Path(frame.f_code.co_filename)).is_relative_to(PACKAGE):
            files.setdefault(str(path.relative_to(PACKAGE)))

    (service,) = (s for s in served.node.services if s.srv_name.endswith("/set_parameters"))
    request = SetParameters.Request(parameters=[Parameter(name, value=value).to_parameter_msg()])
    answer = service.callback(request, SetParameters.Response())
    sys.setprofile(record)
    try:
        response = result_of(answer)
    finally:
        sys.setprofile(None)
    assert [result.reason for result in response.results] == [""]
    return list(files)


@pytest.mark.parametrize(
    ("name", "value"),
    [("confidence_threshold", 0.4), ("iou_threshold", 0.5), ("max_rate", 5.0), ("agnostic_nms", True)],
)
def test_a_live_change_runs_through_the_listed_files(ros_domain: int, name: str, value: object) -> None:
    with ServedNode(Preparations()) as served:
        served.bring_to("active")
        assert files_of_a_change(served, name, value) == listed_files()
        assert served.get(name) == value


def test_the_listed_files_are_few() -> None:
    assert 0 < len(listed_files()) <= MAX_FILES
