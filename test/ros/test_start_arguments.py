"""Parameter files on the command line of a node: read as ROS reads them; those for other nodes are told."""

from __future__ import annotations

import os
import re
import sys
from pathlib import Path

import pytest
from support.detector_process import environment
from support.lone_node import lone_node
from support.worker import worker_domain

from yolov5_lifecycle.ros.child_process import ChildProcess, entry_point
from yolov5_lifecycle.ros.start_arguments import initialize, misaddressed_files, start_arguments
from yolov5_lifecycle.settings.parameter_file import names_node, read_parameter_file

_SCALARS = [
    "~", "null", "010", "08", "0x1F", "5e-1", "nan", ".nan", "-inf", ".inf", "+5", "-0", "1_000", "0o7",
    "2001-01-01", "9223372036854775807", "-.5", "5.", ".5e3", "1.e5", "1e", "y", "N", "NO", "on", "Off",
    "TRUE", "tRUE", "=", "é", "http://host/x", "'12:30'", "'5'", '"yes"', "!!str 5", "!!int 5", "&anchor 5",
]  # fmt: skip
SCALARS = [f"    p{index}: {text}" for index, text in enumerate(_SCALARS)]


def overrides(path: Path, namespace: str = "/a") -> dict[str, object]:
    """What ROS reads in the file for the node yolov5 in `namespace`."""
    words = ("--ros-args", "--params-file", str(path), "-r", f"__ns:={namespace or '/'}")
    with lone_node("yolov5", *words) as node:
        return {name: parameter.value for name, parameter in node._parameter_overrides.items()}


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "parameters.yaml"


@pytest.mark.parametrize(
    "text",
    [
        pytest.param("\n".join(["/**:", "  ros__parameters:", *SCALARS]), id="scalars"),
        pytest.param("/**: {ros__parameters: {a: {b: {c: 1}, d: x}, e.f: 2.5}}", id="nested"),
        pytest.param("/**: {ros__parameters: {a: 1, a: 2}}", id="twice"),
        pytest.param(
            "/**: {ros__parameters: {a: 1}}\n/a/yolov5: {ros__parameters: {a: 2}}\n"
            "/**: {ros__parameters: {a: 3}}",
            id="a section in two places",
        ),
        pytest.param("a/: {yolov5: {ros__parameters: {x: [a, b], y: [1.5, 2.0], z: [on, n]}}}", id="lists"),
        pytest.param(
            "/**: {yolov5: {ros__parameters: {a: 2}}, ros__parameters: {a: 1, b: 1}}",
            id="a node before parameters",
        ),
    ],
)
def test_a_file_is_read_as_ros_reads_it(ros_domain: int, path: Path, text: str) -> None:
    path.write_text(text)
    nodes = read_parameter_file(path)
    values = [values for pattern, values in nodes.items() if names_node(pattern, "/a/yolov5")]
    read = {name: value for node in values for name, value in node.items()}
    assert sorted(map(repr, read.items())) == sorted(map(repr, overrides(path).items()))


def test_bad_files_are_left_out_and_the_others_kept(tmp_path: Path) -> None:
    good, bad = tmp_path / "good.yaml", tmp_path / "bad.yaml"
    good.write_text("/**: {ros__parameters: {a: 1}}")
    bad.write_text("a: [")
    words = ["detector", "--params-file", "x", "--ros-args", "--params-file", str(bad), "-p", "a:=1",
             "--params-file", str(good), "--params-file", "/none", "--", "--params-file", "y"]  # fmt: skip
    given = start_arguments(words)
    assert [*given.words] == [
        *words[:4], "-p", "a:=1", "--params-file", str(good), "--", "--params-file", "y"
    ]  # fmt: skip
    assert list(given.files) == [str(good)]
    assert [path in problem for path, problem in zip((str(bad), "/none"), given.problems, strict=True)]
    assert given.own_words == ["--params-file", "x", "--params-file", "y"]


@pytest.mark.parametrize(
    ("first", "second", "told"),
    [
        pytest.param("device: 0", ["-p", "device:=cpu"], "as 0 in .* as 'cpu' in -p device", id="integer"),
        pytest.param("classes: [0, 2]", ["-p", 'classes:=["cat"]'], r"given twice, as \[0, 2\]", id="lists"),
        pytest.param("cameras: [front]", ["-p", "cameras:=[]"], r"as \[\] in -p", id="empty list"),
        pytest.param("cameras: [front]", ["-p", "cameras:=[rear]"], "", id="lists of one type"),
        pytest.param("cameras: []", ["-p", "cameras:=[rear]"], "", id="strings after an empty list"),
        pytest.param("device: 0", ["-p", "other:device:=cpu"], "", id="another node"),
    ],
)
def test_values_of_two_types_for_one_name_are_a_problem(
    path: Path, first: str, second: list[str], told: str
) -> None:
    path.write_text(f"/**: {{ros__parameters: {{{first}}}}}")
    problems = start_arguments(["detector", "--ros-args", "--params-file", str(path), *second]).problems
    assert len(problems) == bool(told)
    assert all(re.search(told, problem) for problem in problems)


def test_what_only_ros_refuses_is_an_error_in_its_words(ros_domain: int, path: Path) -> None:
    path.write_text("%YAML 1.2\n---\n/**: {}")  # rcl's libyaml is older than PyYAML's
    given = start_arguments(["detector", "--ros-args", "--params-file", str(path)])
    with pytest.raises(RuntimeError, match=f"{path}'. Error: Error parsing a event near line 1$"):
        initialize(given.words)


def test_an_argument_that_is_no_utf8_is_an_error() -> None:
    words = ["detector", "--ros-args", "-p", "weights:=\udcff.pt"]
    with pytest.raises(RuntimeError, match=r"argument 3, weights:=.\.pt: expected UTF-8"):
        start_arguments(words)


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "value"),
    [
        pytest.param("HOME", "", id="no home"),
        pytest.param("ROS_LOG_DIR", "/proc/sys", id="a folder that cannot be written"),
    ],
)
def test_without_a_folder_for_its_log_a_node_names_the_variables(name: str, value: str) -> None:
    """In a process of its own: a failure of ROS's log is not the last one."""
    program = (
        "from yolov5_lifecycle.ros.start_arguments import initialize, start_arguments\n"
        "initialize(start_arguments(['detector']).words)"
    )
    known = {variable: found for variable, found in os.environ.items() if not variable.startswith("ROS_")}
    with ChildProcess("node", [sys.executable, "-c", program], known | {name: value}) as process:
        assert process.wait(60) == 1
    assert re.search(
        r"RuntimeError: .*log.*Set ROS_LOG_DIR to a folder .* in the folder HOME\.$", process.output
    )


# Files for other nodes

TOPS = (
    "/**", "/*", "/*/*", "yolov5", "my_yolo", "left/yolov5", "/**/yolov5", "/*/yolov5", "robot/left/yolov5",
    "/robot/*/yolov5", "robot/**", "/robot/**/yolov5", "/robot/left/*",
)  # fmt: skip


def warnings_about(path: Path, text: str, node: str) -> str:
    path.write_text(text)
    files = start_arguments(["detector", "--ros-args", "--params-file", str(path)]).files
    return " ".join(misaddressed_files(files, node))


@pytest.mark.parametrize("namespace", ["", "/robot/left"])
def test_the_node_warns_exactly_when_ros_ignores_a_file(ros_domain: int, path: Path, namespace: str) -> None:
    for top in TOPS:
        told = warnings_about(path, f"{top}: {{ros__parameters: {{secret: hidden}}}}", f"{namespace}/yolov5")
        assert bool(told) is not bool(overrides(path, namespace)), top
        assert "secret" not in told
        assert "hidden" not in told


@pytest.mark.parametrize(
    ("text", "told"),
    [
        pytest.param(
            "robot:\n  left:\n    my_yolo: {ros__parameters: {a: 5}}", "/robot/left/my_yolo", id="nested"
        ),
        pytest.param(
            "".join(f"node{number}: {{ros__parameters: {{a: 5}}}}\n" for number in range(9)),
            "it is for /node0, /node1, /node2, /node3, /node4, ..., but",
            id="many",
        ),
        pytest.param(
            "/other: {ros__parameters: {a: 1}}\n/yolov5: {ros__parameters: {a: 1}}", "", id="one is this"
        ),
        pytest.param("", "", id="empty"),
    ],
)
def test_the_warning_has_the_names_in_the_file(path: Path, text: str, told: str) -> None:
    found = warnings_about(path, text, "/yolov5")
    assert (told in found) if told else (found == "")


@pytest.mark.long
def test_the_detector_warns_at_its_start(path: Path) -> None:
    path.write_text("my_yolo: {ros__parameters: {a: 1}}")
    command = [entry_point("detector"), "--ros-args", "-r", "__ns:=/robot", "--params-file", str(path)]
    with worker_domain() as domain, ChildProcess("detector", command, environment(domain)) as process:
        process.wait_for_output("it is for /my_yolo, but this node is /robot/yolov5", 60)
