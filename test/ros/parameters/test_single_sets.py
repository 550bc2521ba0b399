"""Wrong files are corrected by single sets in any order, and configure names all that is wrong at once."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from rcl_interfaces.msg import SetParametersResult
from support.preparations import Preparations
from support.served_node import ServedNode, messages_of

from yolov5_lifecycle.settings.camera_overrides import MAX_CAMERAS
from yolov5_lifecycle.settings.settings import validated

Values = dict[str, Any]

MANY = [f"camera{number}" for number in range(MAX_CAMERAS)]


@contextmanager
def detector(folder: Path, given: Values) -> Iterator[ServedNode]:
    """A node that was given these values in a file."""
    file = folder / "parameters.yaml"
    file.write_text(json.dumps({"/**": {"ros__parameters": given}}))
    with ServedNode(Preparations(), arguments=["--ros-args", "--params-file", str(file)]) as served:
        yield served


def put(served: ServedNode, name: str, value: Any) -> SetParametersResult:
    """What `ros2 param set` or, of None, `ros2 param delete` is answered."""
    (result,) = served.set_one_by_one(messages_of(**{name: value}))
    return result


def configure(served: ServedNode) -> str:
    """Why configure is refused, an empty string if it succeeds."""
    return "" if served.transition("configure") else str(served.node._problem)


WRONG_FILE: Values = {
    "cameras": ["front", "front_left", "2nd"],
    "front.max_rate": -1.0,
    "front.track_high_threshold": 0.05,
    "front_left.lazy": "often",
    "2nd.max_rate": 5.0,
    "rear.classes": ["cat"],
    "track_low_threshold": False,
    "min_box_size": 0.4,
    "classes": ["a", ""] * 6000,
    "wieghts": 1.0,
    "front.max_rte": 1.0,
    "classes.cat": 1.0,
    "x.y.z": [],
}
CORRECTIONS: Values = {
    "cameras": ["front", "rear"],
    "front.max_rate": 5.0,
    "front.track_high_threshold": 0.9,
    "max_box_size": 0.5,
    "track_low_threshold": 0.6,
    "track_high_threshold": 0.7,
    "rear.max_rate": 2.0,
    "classes": ["dog"],
}
WANTED = CORRECTIONS | {"min_box_size": 0.4, "rear.classes": ["cat"]}


@pytest.mark.parametrize("is_reversed", [False, True], ids=["from first to last", "from last to first"])
def test_a_wrong_file_is_corrected_by_single_sets_in_any_order(
    ros_domain: int, tmp_path: Path, is_reversed: bool
) -> None:
    with detector(tmp_path, WRONG_FILE) as tried:
        told = configure(tried)
        right = {"min_box_size", "rear.classes", "front.track_high_threshold"}
        assert {*re.findall(r"^  (\S+): ", told, re.MULTILINE)} >= WRONG_FILE.keys() - right
        for name in sorted(CORRECTIONS, reverse=is_reversed):
            result = put(tried, name, CORRECTIONS[name])
            assert result.successful, (name, result.reason)
        for name in {*re.findall(r"ros2 param delete /yolov5 (\S+)$", configure(tried), re.MULTILINE)}:
            assert put(tried, name, None).successful, name
        assert configure(tried) == ""
        assert tried.node._settings.settings() == validated(WANTED)


FRONT_AND_REAR = {"cameras": ["front", "rear"]}


@pytest.mark.parametrize(
    ("given", "told"),
    [
        pytest.param(
            {"cameras": ["front", "classes"], "front.confidence_threshold": 7.0, "front.tracker": "sort"},
            [
                "cameras: ['front', 'classes'] must not hold 'classes', the name of a setting: rename that",
                "front.confidence_threshold: 7.0 is not a number from 0 to 1. The default is 0.25. "
                "Or remove it: ros2 param delete /yolov5 front.confidence_threshold",
                "front.tracker: 'sort' is not one of none, bytetrack. The default is 'none'. Or remove it: ",
            ],
            id="values beside wrong cameras",
        ),
        pytest.param(
            {"cameras": 3, "front.max_rate": 5, "front.lazy": 1},
            [
                "cameras: 3 is not a list",
                "front.max_rate: there is no such parameter: add the camera to cameras, which names none. Or",
                "front.lazy: there is no such parameter: add the camera to cameras, which names none. Or",
                "front.lazy: 1 is not true or false. The default is true.",
            ],
            id="no camera can be read",
        ),
        pytest.param(
            {"cameras": [*MANY, "camera16"], "camera16.max_rate": 5.0, "camera16.lazy": 1},
            ["cameras: ", "camera16.lazy: 1 is not true or false. The default is true."],
            id="too many cameras",
        ),
        pytest.param(
            {"cameras": ["front", "2nd"], "2nd.max_rate": 5.0},
            [
                "cameras: ",
                "2nd.max_rate: there is no such parameter: no camera can have the name '2nd'. Use the "
                "camera's new name. Remove it: ros2 param delete /yolov5 2nd.max_rate",
            ],
            id="name that no camera can have",
        ),
        pytest.param(
            {"cameras": ["front", "2nd"], "qos_overrides./yolov5/front/detections.publisher.depth": 1},
            ["cameras: "],
            id="quality of a camera that is right",
        ),
        pytest.param(
            {"track_high_threshold": 9.0, "track_low_threshold": 0.5},
            ["track_high_threshold: 9.0 is not"],
            id="contradiction that a wrong value leaves undecided",
        ),
        pytest.param(
            {"cameras": 3, "front.track_high_threshold": 9.0, "front.track_low_threshold": 0.5},
            [
                "cameras: ",
                "front.track_high_threshold: there is no such parameter: add",
                "front.track_low_threshold: there is no such parameter: add",
                "front.track_high_threshold: 9.0 is not",
            ],
            id="undecided contradiction of a camera that does not exist",
        ),
    ],
)
def test_configure_names_every_problem_with_its_remedy(
    ros_domain: int, tmp_path: Path, given: Values, told: list[str]
) -> None:
    with detector(tmp_path, given) as tried:
        first, *problems, last = configure(tried).split("\n")
    assert first == f"configure refused, {len(told)} problem(s):"
    assert [problem[2:][: len(beginning)] for problem, beginning in zip(problems, told, strict=True)] == told
    removals = [problem for problem in problems if re.match(r"  \w+: .*ros2 param delete", problem)]
    assert removals == [], "the node's own parameters stay"
    assert last == "  Correct values one by one, in any order: ros2 param set /yolov5 NAME VALUE"


def test_a_wrong_value_stays_one_until_it_is_corrected_itself(ros_domain: int, tmp_path: Path) -> None:
    with detector(tmp_path, {"image_size": [], "nonsense": [], "max_rate": -1.0}) as tried:
        assert configure(tried).startswith("configure refused, 3 problem(s):")
        put(tried, "max_rate", 3.0)
        assert configure(tried).startswith("configure refused, 2 problem(s):")


def test_a_read_only_parameter_of_another_type_is_not_made_right_by_an_equal_value(
    ros_domain: int, tmp_path: Path
) -> None:
    with detector(tmp_path, {"autostart": 0}) as tried:
        assert "read-only: restart the node" in put(tried, "autostart", False).reason
        assert "autostart" in configure(tried)


@pytest.mark.parametrize("given", [{"wieghts": "x"}, {"autostart": 1}], ids=["unknown", "read-only"])
def test_configure_names_no_command_that_cannot_help(ros_domain: int, tmp_path: Path, given: Values) -> None:
    with detector(tmp_path, given) as tried:
        assert "ros2 param set" not in configure(tried)


@pytest.mark.parametrize(
    ("given", "name", "value", "remark"),
    [
        pytest.param({}, "track_low_threshold", 0.9, "track_low_threshold: 0.9 is above", id="contradiction"),
        pytest.param({}, "side.max_rate", 5.0, "add the camera to cameras", id="no camera"),
        pytest.param(FRONT_AND_REAR, "front.track_high_threshold", 0.05, "0.1 is above", id="inherited"),
    ],
)
def test_a_set_that_needs_another_one_says_so_and_is_refused_when_configured(
    ros_domain: int, tmp_path: Path, given: Values, name: str, value: Any, remark: str
) -> None:
    with detector(tmp_path, given) as tried:
        result = put(tried, name, value)
        assert result.successful
        assert result.reason.startswith("change another parameter, too, or configure is refused: ")
        assert remark in result.reason
        assert tried.get(name) == value
        assert remark.rpartition(": ")[2].rstrip(".") in configure(tried)
    with detector(tmp_path, given) as tried:
        assert configure(tried) == ""
        result = put(tried, name, value)
        assert not result.successful
        assert remark in result.reason


def test_deleting_a_parameter_of_the_node_is_refused_with_its_default(
    ros_domain: int, tmp_path: Path
) -> None:
    with detector(tmp_path, {}) as tried:
        assert configure(tried) == ""
        for name, remedy in (("classes", " Set it to its default: []."), ("autostart", "")):
            result = put(tried, name, None)
            assert not result.successful
            assert result.reason == (
                f"{name}: a parameter of the node always has a value and cannot be deleted.{remedy}"
            )


def test_setting_the_parameter_that_was_meant_corrects_the_name(ros_domain: int, tmp_path: Path) -> None:
    with detector(tmp_path, {"cameras": ["front"], "front.max_rte": 5.0}) as tried:
        assert "Did you mean 'front.max_rate'? Set that one, or" in configure(tried)
        assert put(tried, "front.max_rate", 5.0).successful
        assert configure(tried) == ""


def test_what_a_configured_node_was_given_wrong_has_no_effect_later(ros_domain: int, tmp_path: Path) -> None:
    with detector(tmp_path, {"cameras": ["front"], "frnt.max_rate": -1.0}) as tried:
        assert put(tried, "frnt.max_rate", None).successful
        assert configure(tried) == ""
        assert tried.transition("cleanup")
        assert put(tried, "cameras", ["front", "frnt"]).successful
        assert configure(tried) == ""
        assert "frnt.max_rate" not in tried.node._settings.settings().overrides
