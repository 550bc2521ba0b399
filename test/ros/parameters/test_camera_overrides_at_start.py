"""Overrides for single cameras from parameter files and the command line."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.srv import ListParameters
from support.preparations import Preparations
from support.served_node import ServedNode

from yolov5_lifecycle.settings.settings import Settings

FRONT_AND_REAR = "cameras:=[front, rear]"


@pytest.fixture
def prepare(ros_domain: int) -> Preparations:
    return Preparations()


def settings_of(served: ServedNode) -> Settings:
    return served.node._settings.settings()


def refusal_of_configure(served: ServedNode) -> str:
    assert not served.transition("configure")
    return str(served.status().message)


def delete(served: ServedNode, name: str) -> bool:
    (result,) = served.set_one_by_one([ParameterMessage(name=name)])
    return bool(result.successful)


def names(served: ServedNode) -> set[str]:
    return set(served.call("list_parameters", ListParameters.Request()).result.names)


def test_overrides_of_a_file_and_of_the_command_line_are_in_the_logged_table(
    prepare: Preparations, tmp_path: Path
) -> None:
    file = tmp_path / "parameters.yaml"
    file.write_text(
        "/**:\n  ros__parameters:\n    cameras: [front, rear]\n    classes: [cat]\n"
        "    front: {max_rate: 5, classes: []}\n    rear.image_transport: compressed\n"
    )
    words = ["--ros-args", "--params-file", str(file), "-p", "rear.max_rate:=2.5"]
    with ServedNode(prepare, arguments=words) as served:
        assert served.transition("configure")
        settings = settings_of(served)
        assert (settings.for_camera("front").max_rate, settings.for_camera("front").classes) == (5.0, ())
        assert settings.for_camera("rear").max_rate == 2.5
        assert settings.for_camera("rear").image_transport == "compressed"
        assert settings.for_camera("rear").classes == ("cat",)
        served.wait_for_log("configured with")
        (table,) = (said for said in served.log if said.startswith("configured with"))
        rows = {tuple(line.split(maxsplit=2)) for line in table.splitlines()[1:]}
        assert rows >= {
            ("front.max_rate", "5.0", "parameter file"),
            ("front.classes", "[]", "parameter file"),
            ("rear.max_rate", "2.5", "command line"),
        }


@pytest.mark.parametrize(
    ("given", "told", "fixed"),
    [
        pytest.param(
            ["front.max_rate:=-1.0"],
            "front.max_rate: -1.0 is not",
            {"front.max_rate": 5.0},
            id="range",
            marks=pytest.mark.long,
        ),
        pytest.param(
            ["front.lazy:=high"],
            "front.lazy: 'high' is not",
            {"front.lazy": True},
            id="type",
            marks=pytest.mark.long,
        ),
        pytest.param(
            ["front.max_rte:=5.0"], "Did you mean 'front.max_rate'?", {"front.max_rate": 5.0}, id="setting"
        ),
        pytest.param(
            ["side.max_rate:=5.0"],
            "add the camera to cameras, which has front, rear. Or remove it: ros2 param delete /yolov5 side.",
            {"cameras": ["front", "rear", "side"]},
            id="camera-to-add",
        ),
        pytest.param(
            ["front.track_low_threshold:=0.5"],
            "front.track_low_threshold: 0.5 is above",
            {"front.track_high_threshold": 0.6},
            id="contradiction",
        ),
    ],
)
def test_a_bad_override_fails_configure_until_it_is_corrected(
    prepare: Preparations, given: list[str], told: str, fixed: dict[str, Any]
) -> None:
    with ServedNode(prepare, parameters=[FRONT_AND_REAR, *given]) as served:
        assert told in refusal_of_configure(served)
        assert served.set(**fixed) == (True, "")
        assert served.transition("configure")
    assert served.escaped == []


@pytest.mark.long
@pytest.mark.parametrize("prefix", ["", "front."], ids=["node", "camera"])
def test_values_are_judged_with_the_others_that_are_given(prepare: Preparations, prefix: str) -> None:
    thresholds = {"track_low_threshold": 0.5, "track_high_threshold": 0.6}
    given = [f"{prefix}{name}:={value}" for name, value in thresholds.items()]
    with ServedNode(prepare, parameters=[FRONT_AND_REAR, *given]) as served:
        assert served.transition("configure")
        front = settings_of(served).for_camera("front")
        assert (front.track_low_threshold, front.track_high_threshold) == (0.5, 0.6)


@pytest.mark.long
@pytest.mark.parametrize(
    "given", ["front.max_rate:=-1.0", "frnt.max_rate:=5.0", "side.max_rate:=5.0", "front.weights:=x"]
)
def test_a_bad_override_may_be_deleted(prepare: Preparations, given: str) -> None:
    with ServedNode(prepare, parameters=[FRONT_AND_REAR, given]) as served:
        name = given.partition(":=")[0]
        assert f"{name}: " in refusal_of_configure(served)
        assert delete(served, name)
        assert served.transition("configure")
        assert name not in names(served)


def test_every_bad_override_is_reported_at_once(prepare: Preparations) -> None:
    given = ["front.max_rate:=-1.0", "frnt.lazy:=false", "rear.weights:=x", "iou_threshold:=2.0"]
    with ServedNode(prepare, parameters=[FRONT_AND_REAR, *given]) as served:
        told = refusal_of_configure(served)
        assert "4 problem(s)" in told
        assert [parameter.partition(":=")[0] in told for parameter in given] == [True] * 4


def test_an_override_applies_once_its_camera_is_added(prepare: Preparations) -> None:
    given = ["side.max_rate:=5", "side.classes:=[]", "classes:=[cat]"]
    with ServedNode(prepare, parameters=[FRONT_AND_REAR, *given]) as served:
        assert served.set(cameras=["side"]) == (True, "")
        assert served.transition("configure")
        side = settings_of(served).for_camera("side")
        assert (side.max_rate, side.classes) == (5.0, ())
        assert served.get("side.max_rate") == 5.0


def test_an_override_waits_for_its_camera_although_the_setting_of_the_node_is_set(
    prepare: Preparations,
) -> None:
    with ServedNode(prepare, parameters=["side.max_rate:=5.0"]) as served:
        told = refusal_of_configure(served)
        assert "which is empty. Or remove it: ros2 param delete /yolov5 side.max_rate" in told
        assert served.set(max_rate=3.0) == (True, "")
        assert served.set(cameras=["side"]) == (True, "")
        assert served.get("side.max_rate") == 5.0


def test_overrides_wait_for_the_correction_of_invalid_cameras(prepare: Preparations) -> None:
    with ServedNode(prepare, parameters=["cameras:=[front, 2nd]", "front.max_rate:=5.0"]) as served:
        told = refusal_of_configure(served)
        assert "cameras: ['front', '2nd'] must be names" in told
        assert "front.max_rate" not in told
        assert served.set(cameras=["front", "second"]) == (True, "")
        assert served.transition("configure")
        assert settings_of(served).for_camera("front").max_rate == 5.0


def test_an_override_without_cameras_says_what_is_missing(prepare: Preparations) -> None:
    with ServedNode(prepare, parameters=["front.max_rate:=5.0"]) as served:
        assert "add the camera to cameras, which is empty" in refusal_of_configure(served)


def test_thousands_of_unknown_overrides_are_reported_soon(prepare: Preparations, tmp_path: Path) -> None:
    file = tmp_path / "parameters.yaml"
    unknown = "".join(f"      confidence_treshold{number}: 0.5\n" for number in range(5000))
    file.write_text(f"/**:\n  ros__parameters:\n    cameras: [front]\n    front:\n{unknown}")
    with ServedNode(prepare, arguments=["--ros-args", "--params-file", str(file)]) as served:
        assert "5000 problem(s)" in refusal_of_configure(served)
        assert served.set(lazy=False) == (True, "")
