"""A JPEG of each detection: what it shows, how it is named, and how much is written at most."""

from __future__ import annotations

import errno
import shutil
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from support.detected_offline import SET_MODEL, run
from support.recorded_scene import COUNT, SIZE_HW, video

from yolov5_lifecycle.atomic_file import OutputError
from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.images.image import ColourImage
from yolov5_lifecycle.offline.export import exporting
from yolov5_lifecycle.offline.export.exporting import MIN_FREE_BYTES, Crops
from yolov5_lifecycle.offline.export.formats import DetectedImage
from yolov5_lifecycle.offline.image_files import ImageFile
from yolov5_lifecycle.sources.scene import CLASS_NAMES

HEIGHT, WIDTH = SIZE_HW


def detected(*boxes_xyxy: tuple[float, float, float, float], name: str = "a.png") -> DetectedImage:
    """An image whose left half is red and whose right half is blue, with detections of the first class."""
    pixels = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    pixels[:, : WIDTH // 2, 0] = 255
    pixels[:, WIDTH // 2 :, 2] = 255
    count = len(boxes_xyxy)
    found = Detections(
        boxes_xyxy=np.array(boxes_xyxy, np.float32).reshape(count, 4),
        scores=np.full(count, 0.5, np.float32),
        class_ids=np.zeros(count, np.int64),
    )
    return DetectedImage(ImageFile(Path("/shots") / name), ColourImage(pixels, "rgb"), found)


def names(folder: Path) -> set[str]:
    return {str(file.relative_to(folder)) for file in folder.rglob("*.jpg")}


def test_the_command_puts_them_beside_its_output(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = [str(video(tmp_path / "drive.avi")), "--output", str(tmp_path / "found.csv"), "--crops"]
    assert run([*words, *SET_MODEL]) == 0
    rows = (tmp_path / "found.csv").read_text().splitlines()[1:]
    found = names(tmp_path / "found_crops")
    assert len(found) == len(rows)
    assert {name.partition("/")[2].rpartition("_")[0] for name in found} == {
        f"frame_{number:06}" for number in range(COUNT)
    }
    classes = {f"{number}_{name}" for number, name in enumerate(CLASS_NAMES)}
    assert {name.partition("/")[0] for name in found} <= classes
    (tmp_path / "found.csv").unlink()
    assert run([*words, *SET_MODEL]) == 1
    assert "found_crops exists and is not replaced" in capsys.readouterr().err
    assert not (tmp_path / "found.csv").exists()


@pytest.mark.parametrize(
    ("box_xyxy", "size_hw"),
    [
        pytest.param((10.4, 20.6, 49.2, 39.1), (20, 40), id="touched pixels"),
        pytest.param((-30.0, -5.0, 12.0, 4.0), (4, 12), id="over the upper left"),
        pytest.param(
            (WIDTH - 5.0, HEIGHT - 7.0, WIDTH + 9.0, HEIGHT + 9.0), (7, 5), id="over the lower right"
        ),
        pytest.param((33.0, 44.0, 33.0, 44.0), (1, 1), id="a point"),
        pytest.param((WIDTH + 3.0, 44.0, WIDTH + 9.0, 46.0), (2, 1), id="outside"),
    ],
)
def test_a_crop_has_the_pixels_of_its_box(
    box_xyxy: tuple[float, float, float, float], size_hw: tuple[int, int], tmp_path: Path
) -> None:
    Crops(tmp_path / "crops", ["dog"]).write(detected(box_xyxy))
    crop = cv2.imread(str(tmp_path / "crops" / "0_dog" / "a.png_0.jpg"))
    assert crop is not None
    assert crop.shape[:2] == size_hw
    assert crop.mean((0, 1)).argmax() == (2 if box_xyxy[0] < WIDTH / 2 else 0)  # BGR: red on the left


@pytest.mark.parametrize(
    ("class_name", "folder"),
    [
        ("traffic light", "0_traffic_light"),
        ("a/b\\c:d*e", "0_a_b_c_d_e"),
        ("\x00\udcff", "0___"),
        ("狗" * 300, f"0_{'狗' * 40}"),
    ],
)
def test_any_name_of_a_class_and_an_image_makes_a_file_of_its_own(
    class_name: str, folder: str, tmp_path: Path
) -> None:
    crops = Crops(tmp_path / "crops", [class_name])
    files = ["a.png", "a.jpg", "A.png", "\udcff.png", "-rf.png"]
    for name in files:
        crops.write(detected((0, 0, 9, 9), (0, 0, 20, 20), name=name))
    assert names(tmp_path) == {f"crops/{folder}/{name}_{row}.jpg" for name in files for row in (0, 1)}


def test_there_are_at_most_so_many(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(exporting, "MAX_CROPS", 2)
    folder = Crops(tmp_path / "crops", ["dog"])
    folder.write(detected((0, 0, 9, 9)))
    with pytest.raises(OutputError, match="more than 2 detections: raise confidence_threshold"):
        folder.write(detected((0, 0, 9, 9), (9, 9, 20, 20), name="b.png"))
    assert names(tmp_path) == {"crops/0_dog/a.png_0.jpg"}


def test_a_disk_that_is_nearly_full_is_left_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=MIN_FREE_BYTES - 1))
    folder = Crops(tmp_path / "crops", ["dog"])
    folder.write(detected())
    with pytest.raises(OSError, match="less than 256 MiB are free") as error:
        folder.write(detected((0, 0, 9, 9)))
    assert error.value.errno == errno.ENOSPC
    assert names(tmp_path) == set()
