"""A parameter file that is written for another node is reported."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import pytest
import rclpy
from rclpy.node import Node
from support.detector_process import environment
from support.worker import worker_domain

from yolov5_lifecycle.ros.child_process import ChildProcess, entry_point
from yolov5_lifecycle.ros.start_arguments import misaddressed_files, start_arguments
from yolov5_lifecycle.settings.parameter_file import Nodes

PARAMETERS = "ros__parameters: {secret: hidden}"
TOPS = (
    "/**", "/*", "/*/*", "/*/*/*", "/yolov5", "yolov5", "my_yolo", "left/yolov5", "/**/yolov5", "/*/yolov5",
    "/robot/left/yolov5", "robot/left/yolov5", "/robot/*/yolov5", "/robot/**", "robot/**", "/robot/**/yolov5",
    "/robot/left/*",
)  # fmt: skip


def file_for(folder: Path, *names: str) -> Path:
    """A parameter file with these names at its top."""
    path = folder / "parameters.yaml"
    path.write_text("\n".join(f"{name}:\n  {PARAMETERS}" for name in names))
    return path


def files_of(path: Path) -> Mapping[str, Nodes]:
    return start_arguments(["detector", "--ros-args", "--params-file", str(path)]).files


@contextmanager
def node_with(path: Path, namespace: str) -> Iterator[Node]:
    """A node that was given the file."""
    context = rclpy.Context()
    rclpy.init(context=context, args=["--ros-args", "--params-file", str(path)])
    try:
        yield rclpy.create_node("yolov5", namespace=namespace, context=context, enable_rosout=False)
    finally:
        rclpy.shutdown(context=context)


@pytest.mark.parametrize("namespace", ["", "/robot/left"])
def test_the_node_warns_exactly_when_ros_ignores_a_file(
    ros_domain: int, tmp_path: Path, namespace: str
) -> None:
    for top in TOPS:
        path = file_for(tmp_path, top)
        with node_with(path, namespace) as node:
            is_obeyed = "secret" in node._parameter_overrides
            told = list(misaddressed_files(files_of(path), node.get_fully_qualified_name()))
        assert bool(told) is not is_obeyed, top


@pytest.mark.parametrize(
    ("text", "told"),
    [
        pytest.param(
            "robot:\n  left:\n    my_yolo: {ros__parameters: {secret: 5}}", "/robot/left/my_yolo", id="nested"
        ),
        pytest.param(
            "".join(f"node{number}: {{ros__parameters: {{secret: 5}}}}\n" for number in range(9)),
            "it is for /node0, /node1, /node2, /node3, /node4, ..., but",
            id="many",
        ),
        pytest.param(
            f"/other: {{{PARAMETERS}}}\n/yolov5: {{{PARAMETERS}}}", "", id="two nodes, one of them this one"
        ),
        pytest.param("", "", id="empty"),
    ],
)
def test_the_warning_has_the_names_in_the_file_and_nothing_else(tmp_path: Path, text: str, told: str) -> None:
    path = tmp_path / "parameters.yaml"
    path.write_text(text)
    found = " ".join(misaddressed_files(files_of(path), "/yolov5"))
    assert (told in found) if told else (found == "")
    assert "secret" not in found
    assert "hidden" not in found


@pytest.mark.long
def test_the_detector_warns_at_its_start(tmp_path: Path) -> None:
    path = file_for(tmp_path, "my_yolo")
    command = [entry_point("detector"), "--ros-args", "-r", "__ns:=/robot", "--params-file", str(path)]
    with worker_domain() as domain, ChildProcess("detector", command, environment(domain)) as process:
        process.wait_for_output("it is for /my_yolo, but this node is /robot/yolov5", 60)
        assert "secret" not in process.output
