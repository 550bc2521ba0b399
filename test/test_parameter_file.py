"""Settings from parameter files and assignments, as the node would read them."""

from __future__ import annotations

from pathlib import Path

import pytest
from colcon_workspace import REPOSITORY

from yolov5_lifecycle.offline.detect_bag import wanted_settings
from yolov5_lifecycle.parameter_file import ParameterFileError, assigned_value, file_values
from yolov5_lifecycle.settings import Settings


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "parameters.yaml"


@pytest.mark.parametrize(
    ("text", "node", "values"),
    [
        pytest.param("/**: {ros__parameters: {image_size: 320}}", "/a/b", {"image_size": 320}, id="any node"),
        pytest.param("yolov5: {ros__parameters: {device: 0}}", "/yolov5", {"device": "0"}, id="short name"),
        pytest.param("/a/b: {ros__parameters: {lazy: no}}", "/a/b", {"lazy": False}, id="full name"),
        pytest.param("a: {b: {ros__parameters: {lazy: true}}}", "/a/b", {"lazy": True}, id="nested name"),
        pytest.param("/*/b: {ros__parameters: {lazy: true}}", "/a/b", {"lazy": True}, id="one part"),
        pytest.param("/**/b: {ros__parameters: {lazy: true}}", "/b", {"lazy": True}, id="any parts"),
        pytest.param("yolov5: {ros__parameters: }", "/yolov5", {}, id="nothing"),
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
        pytest.param("front: {ros__parameters: {lazy: true}}", "found of: /front.", id="another node"),
        pytest.param("/*: {ros__parameters: {lazy: true}}", "found of: /*.", id="another depth"),
        pytest.param("image_size: 320", "found of: none.", id="no node"),
        pytest.param("", "found of: none.", id="empty"),
        pytest.param("a: [", "this is no YAML", id="no YAML"),
        pytest.param("a: \udcff", "this is no YAML", id="no text"),
        pytest.param('"a"\U00108ff0', r'"a"\?', id="what cannot be printed"),
        pytest.param("a: 2001-99-99", "month must be in", id="no date"),
        pytest.param("a: &a {ros__parameters: *a}", "recursion", id="endless"),
    ],
)
def test_a_file_that_says_nothing_to_the_node_is_an_error(path: Path, text: str, told: str) -> None:
    path.write_bytes(text.encode(errors="surrogateescape"))
    with pytest.raises(ParameterFileError, match=told):
        file_values(path, "/a/yolov5")


@pytest.mark.parametrize(
    ("assignment", "value"),
    [
        pytest.param("confidence_threshold=0.4", ("confidence_threshold", 0.4), id="number"),
        pytest.param("confidence_threshold=1", ("confidence_threshold", 1.0), id="whole number"),
        pytest.param("classes=[circle, star]", ("classes", ["circle", "star"]), id="list"),
        pytest.param("classes=[0, 2]", ("classes", ["0", "2"]), id="list of numbers"),
        pytest.param("classes=[dog, 2]", ("classes", ["dog", "2"]), id="names and numbers"),
        pytest.param("classes=[dog, 2.5]", ("classes", ["dog", 2.5]), id="what is no class"),
        pytest.param("classes=[]", ("classes", []), id="empty list"),
        pytest.param("device=1", ("device", "1"), id="number for a text"),
        pytest.param("weights=/a=b.pt", ("weights", "/a=b.pt"), id="equals in the value"),
        pytest.param("weights=", ("weights", ""), id="empty text"),
        pytest.param("model_size=n", ("model_size", "n"), id="n"),
        pytest.param("wheels=4", ("wheels", 4), id="no setting"),
    ],
)
def test_an_assignment_has_the_type_of_its_setting(assignment: str, value: tuple[str, object]) -> None:
    assert assigned_value(assignment) == value


def test_an_assignment_wins_over_the_file() -> None:
    demo = REPOSITORY / "config" / "demo.yaml"
    settings = wanted_settings(demo, ["image_size=640", "classes=[1]"], "/yolov5")
    assert (settings.image_size, settings.classes, settings.device) == (640, ("1",), "cpu")


def test_the_file_with_all_defaults_changes_nothing() -> None:
    assert wanted_settings(REPOSITORY / "config" / "yolov5.yaml", [], "/anything") == Settings()
