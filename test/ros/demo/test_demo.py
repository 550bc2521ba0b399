"""`make demo` and `make demo-cameras`: the command as a user runs it, and what it compares."""

from __future__ import annotations

import os
import re
import signal
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from sensor_msgs.msg import Image, PointCloud2
from std_msgs.msg import Header
from vision_msgs.msg import (
    Detection2D,
    Detection2DArray,
    Detection3D,
    Detection3DArray,
    ObjectHypothesis,
    ObjectHypothesisWithPose,
)

from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.images.image import ColourImage
from yolov5_lifecycle.ros.child_process import ChildProcess, entry_point
from yolov5_lifecycle.ros.demo.command import main
from yolov5_lifecycle.ros.demo.demonstrations import (
    figures,
    from_above,
    mask_ious,
    matched,
    points_near,
    side_by_side,
)
from yolov5_lifecycle.ros.demo.stage import saved
from yolov5_lifecycle.ros.messages import image_message, point_cloud_message
from yolov5_lifecycle.ros.observer import PATIENCE_S
from yolov5_lifecycle.spatial.points import SurfacePoints

Objects = Sequence[tuple[str, float]]
"""Class and left edge of squares of 10 pixels."""
TRUTH: Objects = (("circle", 0.0), ("star", 20.0), ("star", 40.0))
TRUE_IDS = ("1", "2", "3")


def message(objects: Objects, ids: Sequence[str] = TRUE_IDS) -> Detection2DArray:
    detections = []
    for (name, left), object_id in zip(objects, ids, strict=False):
        hypothesis = ObjectHypothesis(class_id=name, score=0.9)
        found = Detection2D(id=object_id, results=[ObjectHypothesisWithPose(hypothesis=hypothesis)])
        found.bbox.center.position.x, found.bbox.size_x, found.bbox.size_y = left + 5.0, 10.0, 10.0
        detections.append(found)
    return Detection2DArray(detections=detections)


def places(ids: Sequence[str], scale: float = 1.0) -> Detection3DArray:
    """One, two and three metres in front of the camera."""
    placed = Detection3DArray()
    for z, object_id in enumerate(ids, start=1):
        found = Detection3D(id=object_id)
        found.bbox.center.position.z = z * scale
        placed.detections.append(found)
    return placed


def frame(
    *,
    camera: str = "front",
    ids: Sequence[str] = ("7", "8", "9"),
    objects: Objects = TRUTH,
    placed: Detection3DArray | None = None,
) -> tuple[Any, ...]:
    """An image of TRUTH in which `objects` were found."""
    found = message(objects, ids)
    return camera, message(TRUTH), places(TRUE_IDS), found, places(ids) if placed is None else placed


@pytest.mark.end_to_end
@pytest.mark.parametrize(
    ("words", "image", "size_hw"),
    [
        pytest.param([], "annotated.png", (480, 640), id="one camera"),
        pytest.param(["--cameras"], "cameras.png", (388, 1624), id="two cameras"),
    ],
)
def test_the_demo_passes_and_leaves_its_image(
    words: list[str], image: str, size_hw: tuple[int, int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with ChildProcess("demo", [entry_point("demo"), *words], os.environ) as demo:
        code = demo.wait(250.0)
    assert code == 0, demo.output
    assert demo.output.splitlines()[-1].startswith("demo ok: ")
    drawn = cv2.imread(str(tmp_path / "build" / "demo" / image))
    assert drawn is not None
    assert drawn.shape == (*size_hw, 3)


def test_the_demo_says_why_it_cannot_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "build").write_text("a file where a folder should be")
    before = signal.getsignal(signal.SIGTERM)
    assert main([]) == 1
    signal.signal(signal.SIGTERM, before)
    assert capsys.readouterr().out.startswith("demo failed: ")


@pytest.mark.long
def test_the_end_of_the_demo_ends_what_it_started(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with ChildProcess("demo", [entry_point("demo")], os.environ) as demo:
        demo.wait_for_output("] started", PATIENCE_S)
        started = re.findall(r"process (\d+)", demo.output)
        assert demo.stop(signal.SIGTERM) == 143
    assert len(started) == 2
    assert not any(Path(f"/proc/{process_id}").exists() for process_id in started)


@pytest.mark.parametrize(
    ("seen", "pairs"),
    [
        pytest.param([*TRUTH[:0:-1], ("circle", 1.0)], [(2, 0), (1, 1), (0, 2)], id="in another order"),
        pytest.param([("star", 21.0), ("star", 22.0)], [(1, 0)], id="found twice"),
        pytest.param([("square", 0.0)], [], id="another class"),
        pytest.param([("circle", 4.0)], [], id="beside it"),
    ],
)
def test_objects_are_matched_one_to_one_and_within_their_class(
    seen: Objects, pairs: list[tuple[int, int]]
) -> None:
    assert sorted(matched(message(TRUTH), message(seen))) == sorted(pairs)
    assert matched(message([]), message(seen)) == []
    assert matched(message([("star", 0.0), ("star", 2.0)]), message([("star", 0.5)])) == [(0, 0)]


def masks(**columns: slice) -> Image:
    """Labels of 8x20 pixels: the number written behind `of_` in each of these columns."""
    labels = np.zeros((8, 20), np.uint16)
    for name, part in columns.items():
        labels[:, part] = int(name.removeprefix("of_"))
    return image_message(labels, "16UC1", Header())


def test_the_pixels_of_objects_that_belong_together_are_compared() -> None:
    true = masks(of_1=slice(0, 10), of_2=slice(10, 20))
    exchanged = masks(of_2=slice(0, 10), of_1=slice(10, 20))
    assert mask_ious([(0, 1), (1, 0)], true, exchanged) == [1.0, 1.0]
    assert mask_ious([(0, 0), (1, 1)], true, masks(of_1=slice(5, 15))) == pytest.approx([1 / 3, 0])


@pytest.mark.parametrize(
    ("changed", "expected"),
    [
        pytest.param(frame(), (1.0, 0, 0.0), id="perfect"),
        pytest.param(frame(ids=("7", "9", "8")), (1.0, 2, 0.0), id="exchanged ids"),
        pytest.param(frame(ids=("7", "8", "5")), (1.0, 1, 0.0), id="a new id"),
        pytest.param(frame(camera="rear", ids=("7", "5", "6")), (1.0, 1, 0.0), id="shared id"),
        pytest.param(frame(ids=("", "8", "9")), (1.0, 0, 0.0), id="no id for a while"),
        pytest.param(frame(objects=TRUTH[:1]), (4 / 6, 0, 0.0), id="missed"),
        pytest.param(frame(placed=places("789", 1.2)), (1.0, 0, 0.1), id="wrong places"),
        pytest.param(frame(placed=places("")), (1.0, 0, float("inf")), id="no places"),
    ],
)
def test_the_figures_show_what_is_wrong(changed: tuple[Any, ...], expected: tuple[float, int, float]) -> None:
    assert figures([frame(), changed]) == pytest.approx(expected)


def cloud_of(xyz_m: Sequence[Sequence[float]], detections: Sequence[int]) -> PointCloud2:
    """Green points of the detections of TRUTH."""
    green = ColourImage(np.full((1, 1, 3), (0, 255, 0), np.uint8), "bgr")
    nowhere = np.zeros(1, np.intp)
    points = [
        SurfacePoints(box, np.array([place], np.float32), nowhere, nowhere)
        for box, place in zip(detections, xyz_m, strict=True)
    ]
    found = Detections(np.zeros((3, 4), np.float32), np.full(3, 0.9, np.float32), np.zeros(3, np.int64))
    return point_cloud_message(points, found, green, Header())


def test_points_count_beside_the_true_place_of_their_own_object() -> None:
    _, *of_image = frame()
    at_both = [(0, 0, 1.0), (0.04, 0, 2.04), (0, 0.06, 2.0), (0, 0, 1.0)]
    assert points_near([(*of_image, cloud_of(at_both, (0, 1, 1, 1)))]) == 0.5
    assert points_near([]) == 0


def test_points_are_shown_from_above_the_camera_below() -> None:
    seen = from_above(cloud_of([(0.1, 5, 1.8), (1.1, 0, 3.5), (0, 0, 9)], (0, 0, 0)))
    rows, columns = np.nonzero((seen == (0, 255, 0)).all(axis=2))
    assert {*zip((rows // 90).tolist(), (columns // 90).tolist(), strict=True)} == {(2, 2), (0, 3)}


def test_the_image_shows_both_images_below_their_names(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    high, low = np.full((60, 30, 3), (10, 20, 200), np.uint8), np.full((40, 20, 3), (250, 20, 10), np.uint8)
    both = side_by_side({"front": high, "rear": low})
    assert both.shape == (88, 58, 3)
    assert (both[28:, :30] == high).all()
    assert (both[28:68, 38:] == low).all()
    assert (both[:28, :30] < 255).any()
    with pytest.raises(OSError, match="cannot be written"):
        saved(both, "both.png")
