"""Images and videos as files: what is read, and whether an annotated video is whole."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from support.recorded_scene import video

from yolov5_lifecycle.images.image import ColourImage, ImageError
from yolov5_lifecycle.offline.export.exporting import annotated_video, is_whole_video
from yolov5_lifecycle.offline.image_files import ImageFile, VideoFile
from yolov5_lifecycle.sources.frames import SourceError


def test_a_link_to_a_device_is_no_image(tmp_path: Path) -> None:
    (tmp_path / "1.jpg").symlink_to("/dev/zero")
    with pytest.raises(ImageError, match="expected a regular file, found a pipe or device"):
        ImageFile(tmp_path / "1.jpg").load()


def test_a_pipe_is_no_video(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "drive.mp4")
    with pytest.raises(SourceError, match="not a regular file"):
        VideoFile.open(tmp_path / "drive.mp4")


@pytest.mark.parametrize(
    "make",
    [
        pytest.param(Path.touch, id="empty"),
        pytest.param(lambda path: os.truncate(video(path), 400), id="cut off"),
    ],
)
def test_what_is_no_video_is_refused(tmp_path: Path, make: Callable[[Path], object]) -> None:
    make(tmp_path / "drive.avi")
    with pytest.raises(SourceError, match=r"neither as an image nor|without a readable image"):
        VideoFile.open(tmp_path / "drive.avi")


def written(path: Path, *sizes_hw: tuple[int, int]) -> Path:
    """A frame of noise of each size, as `detect_bag` writes them; raises OutputError if it is not whole."""
    generator = np.random.default_rng(0)
    undrawn: Any = SimpleNamespace(drawn=lambda image, _: image)
    with annotated_video(path, 12.5, undrawn) as write:
        for size_hw in sizes_hw:
            image = ColourImage(generator.integers(0, 256, (*size_hw, 3), np.uint8), "bgr")
            found: Any = SimpleNamespace(image=image, detections=None)
            write(found)
    return path


def test_frames_that_change_their_size_are_all_drawn(tmp_path: Path) -> None:
    capture = cv2.VideoCapture(str(written(tmp_path / "drawn.mp4", (48, 64), (24, 32), (96, 64))))
    assert [capture.read()[0] for _ in range(4)] == [True, True, True, False]


@pytest.mark.parametrize("missing_share", [0.0, 0.5, 1.0])
def test_a_video_without_its_end_is_not(missing_share: float, tmp_path: Path) -> None:
    path = written(tmp_path / "cut_off.mp4", *[(48, 64)] * 5)
    size = path.stat().st_size
    os.truncate(path, size - max(1, int(missing_share * size)))
    assert not is_whole_video(path)


@pytest.mark.parametrize(
    ("name", "content", "is_whole"),
    [
        pytest.param("large.mp4", b"\0\0\0\1mdat" + bytes(7) + b"\x10\0\0\0\x08moov", True, id="64 bits"),
        pytest.param("begun.mp4", b"\0\0\0\0mdat" + bytes(50), False, id="box of unknown length"),
        pytest.param("begun.mp4", b"\0\0\0\x08free\0\0\0\x08mdat", False, id="no index"),
        pytest.param("odd.mp4", b"\0\0", False, id="two bytes"),
    ],
)
def test_the_lengths_of_the_boxes_decide(name: str, content: bytes, is_whole: bool, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(content)
    assert is_whole_video(tmp_path / name) == is_whole
