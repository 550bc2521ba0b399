"""Settings from parameter files and assignments, as the node would read them."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from support.colcon_workspace import REPOSITORY

from yolov5_lifecycle.offline.detector_options import wanted_settings
from yolov5_lifecycle.settings.parameter_file import (
    ParameterFileError,
    assigned_value,
    file_values,
)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "parameters.yaml"


@pytest.mark.parametrize(
    ("text", "node", "values"),
    [
        pytest.param("a: {b: {ros__parameters: {lazy: true}}}", "/a/b", {"lazy": True}, id="nested name"),
        pytest.param(
            "/**: {ros__parameters: {lazy: true, image_size: 64}}\nb: {ros__parameters: {lazy: false}}",
            "/b",
            {"lazy": False, "image_size": 64},
            id="later wins",
        ),
        pytest.param(
            "b: {ros__parameters: {use_sim_time: true, qos_overrides: {/clock: {depth: 1}}, wheels: 4}}",
            "/b",
            {"wheels": 4},
            id="ROS's own",
        ),
        pytest.param(
            "b: {ros__parameters: {device: 1, front: {classes: [0], lazy: true}, front.max_rate: 2}}",
            "/b",
            {"device": "1", "front.classes": ["0"], "front.lazy": True, "front.max_rate": 2},
            id="types of settings, nested or dotted",
        ),
    ],
)
def test_a_file_speaks_to_the_nodes_it_names(
    path: Path, text: str, node: str, values: dict[str, object]
) -> None:
    path.write_text(text)
    assert file_values(path, node) == values


@pytest.mark.parametrize(
    ("text", "told"),
    [
        pytest.param("front: {ros__parameters: {lazy: true}}", "found those of: /front.", id="another node"),
        pytest.param("image_size: 320", "line 1: 'image_size' has a value", id="no node"),
        pytest.param("", "found those of: none.", id="empty"),
        pytest.param("a: \udcff", "invalid|can't decode", id="not UTF-8"),
        pytest.param("a: &a {ros__parameters: *a}", r"line 1: an alias \(\*a\)", id="alias"),
        pytest.param("a: {ros__parameters: }", "line 1: expected names and values", id="nothing"),
        pytest.param(
            "/**:\n  ros__parameters: {a: 1}\n  b: {ros__parameters: {a: 2}}",
            r"line 3: 'b' follows the ros__parameters of '/\*\*'.* to the left margin, as '/\*\*/b:'",
            id="a node after parameters",
        ),
        pytest.param(
            "a: {ros__parameters: {b: 1}, ros__parameters: {c: 1}}",
            "a second .* join it",
            id="parameters twice",
        ),
        pytest.param(
            "a: {ros__parameters: {b: {c: {}}, d: 1}}",
            r"expected a value of 'b\.c', found {}: an empty list is \[\]",
            id="mapping for a value",
        ),
        pytest.param(
            "a: {ros__parameters: {classes: [dog, cat:0.5]}}",
            r"line 1: 'cat:0.5' has a colon within \[\] or \{\}: write it in quotes",
            id="colon in a list",
        ),
        pytest.param("a: {ros__parameters: {a: 12:30}}", "'12:30' has a colon", id="colon in braces"),
        pytest.param("a: {ros__parameters: {b: 1, b: x}}", "'b' has a value of another type", id="two types"),
        pytest.param("a: {ros__parameters: {b: [[1, 2]]}}", "values alone, no lists", id="a list in a list"),
        pytest.param("just text", "line 1: expected names of nodes", id="text"),
        pytest.param("ros__parameters: {a: 1}", "above ros__parameters is no name", id="no name"),
    ],
)
def test_a_file_that_the_node_cannot_use_is_an_error(path: Path, text: str, told: str) -> None:
    path.write_bytes(text.encode(errors="surrogateescape"))
    with pytest.raises(ParameterFileError, match=told):
        file_values(path, "/a/yolov5")


@pytest.mark.parametrize(
    ("text", "told"),
    [
        pytest.param("{a: " * 5000, "recursion", id="mappings"),
        pytest.param("a: {ros__parameters: {b: " + "9" * 5000 + "}}", "Exceeds the limit", id="digits"),
        pytest.param("#" * (1 << 20) + "#", "more than 1048576 bytes", id="large"),
    ],
)
def test_a_file_that_is_too_much_is_refused(path: Path, text: str, told: str) -> None:
    path.write_text(text)
    with pytest.raises(ParameterFileError, match=told):
        file_values(path, "/a")


def test_what_is_no_file_is_refused_without_waiting(path: Path) -> None:
    os.mkfifo(path)
    for what, told in ((path, "expected a regular file"), (path.parent, "found a folder")):
        with pytest.raises(ParameterFileError, match=told):
            file_values(what, "/a")


@pytest.mark.parametrize(
    ("assignment", "value"),
    [
        pytest.param("confidence_threshold=0.4", ("confidence_threshold", 0.4), id="number"),
        pytest.param("classes=[0, 2]", ("classes", ["0", "2"]), id="list of numbers"),
        pytest.param('classes=[dog, "2"]', ("classes", ["dog", "2"]), id="names and numbers"),
        pytest.param("device=1", ("device", "1"), id="number for a text"),
        pytest.param("weights=/a=b.pt", ("weights", "/a=b.pt"), id="equals in the value"),
        pytest.param("weights=", ("weights", ""), id="empty text"),
        pytest.param("wheels=4", ("wheels", 4), id="no setting"),
        pytest.param("front.classes=[0]", ("front.classes", ["0"]), id="list of a camera"),
    ],
)
def test_an_assignment_has_the_type_of_its_setting(assignment: str, value: tuple[str, object]) -> None:
    assert assigned_value(assignment) == value


@pytest.mark.parametrize(
    ("assignment", "told"),
    [
        pytest.param("classes=[dog, 2]", r'write \["dog", "2"\]', id="two types"),
        pytest.param("classes=[1, 0.5]", r"write \[1\.0, 0\.5\]", id="two kinds of numbers"),
        pytest.param("classes={dog: 1}", "expected a value", id="mapping"),
        pytest.param("classes=*dog", "an alias", id="alias"),
        pytest.param("classes= #", "found nothing", id="comment"),
        pytest.param("classes", "expected NAME=VALUE", id="no value"),
        pytest.param("classes=[", r"^'classes=\['", id="cut off"),
    ],
)
def test_an_assignment_that_ros_would_not_read_is_refused(assignment: str, told: str) -> None:
    with pytest.raises(ParameterFileError, match=told):
        assigned_value(assignment)


def test_an_assignment_wins_over_the_file() -> None:
    demo = REPOSITORY / "config" / "demo.yaml"
    settings = wanted_settings(demo, ["image_size=640", "classes=[1]"], "/yolov5")
    assert (settings.image_size, settings.classes, settings.device) == (640, ("1",), "cpu")
