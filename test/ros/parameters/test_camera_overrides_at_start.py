"""Overrides for single cameras from parameter files and the command line."""

from __future__ import annotations

from pathlib import Path

import pytest
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


def test_an_override_applies_once_its_camera_is_added(prepare: Preparations) -> None:
    given = ["side.max_rate:=5", "side.classes:=[]", "classes:=[cat]"]
    with ServedNode(prepare, parameters=[FRONT_AND_REAR, *given]) as served:
        assert served.set(cameras=["side"]) == (True, "")
        assert served.transition("configure")
        side = settings_of(served).for_camera("side")
        assert (side.max_rate, side.classes) == (5.0, ())
        assert served.get("side.max_rate") == 5.0


def test_thousands_of_unknown_overrides_are_reported_soon(prepare: Preparations, tmp_path: Path) -> None:
    file = tmp_path / "parameters.yaml"
    unknown = "".join(f"      confidence_treshold{number}: 0.5\n" for number in range(5000))
    file.write_text(f"/**:\n  ros__parameters:\n    cameras: [front]\n    front:\n{unknown}")
    with ServedNode(prepare, arguments=["--ros-args", "--params-file", str(file)]) as served:
        assert "5000 problem(s)" in refusal_of_configure(served)
        assert served.set(lazy=False) == (True, "")
