"""`make demo-cameras`: the command as a user runs it, and the figures that it judges by."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from support.colcon_workspace import REPOSITORY

from yolov5_lifecycle.images.image import ColourImage
from yolov5_lifecycle.ros.demo.camera_figures import CameraFigures, figures
from yolov5_lifecycle.ros.demo.camera_record import JudgedFrame, Places
from yolov5_lifecycle.ros.demo.child_process import ChildProcess, entry_point
from yolov5_lifecycle.ros.demo.command import main
from yolov5_lifecycle.ros.demo.driven_detector import DETECTOR
from yolov5_lifecycle.ros.demo.ground_truth import Sighting, matched
from yolov5_lifecycle.ros.demo.image_file import saved, side_by_side
from yolov5_lifecycle.ros.demo.several_cameras import CAMERAS, problems_of

BOXES = np.array([[0, 0, 10, 10], [20, 0, 30, 10], [40, 0, 50, 10]], np.float64)
NAMES = ("circle", "star", "star")
TRUE_IDS = ("1", "2", "3")
PLACES = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 2.0], [0.0, 3.0, 4.0]])
PERIOD_NS = 200_000_000
FRAMES = 20


def places(ids: tuple[str, ...], scale: float = 1.0) -> Places:
    return {name: place * scale for name, place in zip(ids, PLACES, strict=True) if name}


def frame(
    number: int,
    *,
    ids: tuple[str, ...] = ("7", "8", "9"),
    names: tuple[str, ...] = NAMES,
    scale: float = 1.0,
    rows: int = 3,
) -> JudgedFrame:
    """Three true objects, of which the first `rows` were found, with these ids and classes."""
    stamp_ns = number * PERIOD_NS
    return JudgedFrame(
        truth=Sighting(stamp_ns, 0.0, NAMES, (1.0,) * 3, BOXES, TRUE_IDS),
        true_places=places(TRUE_IDS),
        found=Sighting(stamp_ns, 30.0, names[:rows], (0.9,) * rows, BOXES[:rows], ids[:rows]),
        places=places(ids, scale),
    )


@pytest.mark.end_to_end
def test_the_demo_of_two_cameras_passes_and_leaves_image_and_figures(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with ChildProcess(
        "demo", [entry_point("demo"), "--cameras", "--frames", str(FRAMES)], os.environ
    ) as demo:
        code = demo.wait(250.0)
    assert code == 0, demo.output
    assert demo.output.splitlines()[-1].startswith("demo ok: ")
    found = json.loads((tmp_path / "build/demo/cameras.json").read_text())
    assert found["problems"] == []
    assert found["cameras"].keys() == {camera.name for camera in CAMERAS}
    assert all(one["frames"] >= FRAMES and one["switches"] == 0 for one in found["cameras"].values())
    image = cv2.imread(str(tmp_path / "build/demo/cameras.png"))
    assert image is not None
    assert image.shape[1] > sum(camera.size_hw[1] for camera in CAMERAS)


@pytest.mark.parametrize(
    "words",
    [
        pytest.param(["--frames", "20"], id="without cameras"),
        pytest.param(["--cameras", "--frames", "1"], id="too few for a rate"),
        pytest.param(["--cameras", "--frames", "many"], id="no number"),
    ],
)
def test_a_wrong_number_of_frames_is_refused(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(words)
    assert ended.value.code == 2
    assert "--frames" in capsys.readouterr().err


def test_the_parameter_file_has_the_cameras_and_rates_of_the_demo() -> None:
    content = yaml.safe_load((REPOSITORY / "config" / "demo_cameras.yaml").read_text())
    parameters = content[DETECTOR.removeprefix("/")]["ros__parameters"]
    assert parameters["cameras"] == [camera.name for camera in CAMERAS]
    for camera in CAMERAS:
        assert parameters.get(camera.name, {}).get("max_rate", camera.rate_hz) == camera.max_rate_hz


def test_a_camera_is_started_below_its_name_and_received_from_there() -> None:
    front = CAMERAS[0]
    assert {"__node:=front", "image_raw:=/front/image_raw", "depth:=True"} <= set(front.command)
    assert front.remappings == {
        "~/front/image_raw": "/front/image_raw",
        "~/front/depth/image_raw": "/front/depth/image_raw",
        "~/front/depth/camera_info": "/front/depth/camera_info",
    }


def test_objects_are_matched_one_to_one_and_within_their_class() -> None:
    truth = frame(0).truth
    doubled = Sighting(0, 0.0, ("star", "star", "square"), (0.9,) * 3, BOXES[[1, 1, 0]] + 1)
    assert matched(truth, doubled) == [(1, 0)]
    nothing = Sighting(0, 0.0, (), (), np.zeros((0, 4)))
    assert matched(truth, nothing) == matched(nothing, truth) == []


def test_a_perfect_record_has_no_problems() -> None:
    found = figures([frame(number) for number in range(5)])
    assert (found.frames, found.precision, found.recall, found.switches, found.placed) == (5, 1, 1, 0, 1)
    assert found.rate_hz == pytest.approx(5.0)
    assert found.ids == ("7", "8", "9")
    assert (found.median_error_percent, found.median_latency_ms) == (0, 30)
    assert found.problems() == []


@pytest.mark.parametrize(
    ("changed", "problem"),
    [
        pytest.param(frame(1, ids=("7", "9", "8")), "2 identity switches", id="exchanged ids"),
        pytest.param(frame(1, ids=("7", "8", "5")), "1 identity switches", id="a new id"),
        pytest.param(frame(1, names=("star", "circle", "circle")), "precision 50.0%", id="wrong classes"),
        pytest.param(frame(1, rows=1), "recall 66.7%", id="missed"),
        pytest.param(frame(1, scale=1.2), "error in space 10.00 %", id="wrong places"),
    ],
)
def test_what_is_wrong_is_a_problem(changed: JudgedFrame, problem: str) -> None:
    assert any(problem in told for told in figures([frame(0), changed]).problems())


def test_frames_without_depth_are_a_problem_but_no_error_in_space() -> None:
    bare = [JudgedFrame(one.truth, one.true_places, one.found, {}) for one in (frame(0), frame(1))]
    found = figures(bare)
    assert found.median_error_percent is None
    assert found.problems() == ["0.0% of tracked objects placed in space, expected at least 80%"]
    json.dumps(found.as_json(), allow_nan=False)


def test_an_id_lost_for_a_while_is_no_switch() -> None:
    assert figures([frame(0), frame(1, ids=("", "8", "9")), frame(2)]).switches == 0


@pytest.fixture
def good() -> dict[str, CameraFigures]:
    return {
        camera.name: figures([frame(n, ids=(f"{place}1", f"{place}2", f"{place}3")) for n in range(3)])
        for place, camera in enumerate(CAMERAS)
    }


def test_good_figures_of_all_cameras_are_no_problem(good: dict[str, CameraFigures]) -> None:
    assert problems_of(good) == []


def test_an_id_that_both_cameras_use_is_a_problem(good: dict[str, CameraFigures]) -> None:
    assert problems_of({"front": good["front"], "rear": good["front"]}) == [
        "ids that both cameras use: 01, 02, 03"
    ]


def test_a_camera_above_its_rate_is_a_problem(good: dict[str, CameraFigures]) -> None:
    fast = figures([frame(0, ids=("a", "b", "c")), frame(1, ids=("a", "b", "c"))])
    assert problems_of({**good, "rear": replace(fast, rate_hz=9.0)}) == [
        "rear: 9.0 Hz, expected at most 5 Hz"
    ]


def test_the_image_shows_both_images_beside_each_other_in_their_colours(tmp_path: Path) -> None:
    high = ColourImage(np.full((60, 30, 3), (10, 20, 200), np.uint8), "bgr")
    low = ColourImage(np.full((40, 20, 3), (250, 20, 10), np.uint8), "rgb")
    path = saved(side_by_side({"front": high, "rear": low}), tmp_path / "both.png")
    pixels = cv2.imread(str(path))
    assert pixels is not None
    assert pixels.shape[0] > 60
    assert 50 <= pixels.shape[1] < 70
    assert pixels[50, 5].tolist() == [10, 20, 200]
    assert pixels[50, -5].tolist() == [10, 20, 250]
    assert pixels[-1, -5].tolist() == [255, 255, 255]


def test_an_image_that_cannot_be_written_is_reported(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="cannot be written"):
        saved(ColourImage(np.zeros((2, 2, 3), np.uint8), "bgr"), tmp_path / "nowhere" / "both.png")
