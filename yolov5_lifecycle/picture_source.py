"""Where a camera's pictures come from: a synthetic scene, a device, a video or picture files."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.images import Picture
from yolov5_lifecycle.scene import Scene, Truth

SYNTHETIC = "synthetic"
PICTURE_SUFFIXES = (".jpg", ".jpeg", ".png", ".bmp", ".webp", ".tif", ".tiff")
PICTURE_RATE_HZ = 30.0
"""Of what has no rate of its own."""
_MAX_VIDEO_RATE_HZ = 1000.0
_DEFAULT_SCENE_HW = (480, 640)


class SourceError(ValueError):
    """A source that does not exist, cannot be read or went away; the message says which and what to do."""


@dataclass(frozen=True)
class SourceFrame:
    """One picture and, from the synthetic scene alone, what it shows."""

    picture: Picture
    truth: Truth | None = None


@dataclass(frozen=True)
class PictureSource:
    """Frames, and how many a second it takes to show them as they are meant.

    `rate_hz` is None for a device: that gives a frame when it has one, whether somebody asks or not.
    """

    frames: Iterator[SourceFrame]
    rate_hz: float | None


def open_source(
    source: str, *, size_hw: tuple[int, int] | None = None, seed: int = 0, loop: bool = True
) -> PictureSource:
    """The frames of `source`: "synthetic", the number of a device, the path of a video, picture or folder.

    `size_hw` is the size that every picture gets, None that of the source (the scene: 480 x 640). Files begin
    anew at their end when `loop`, else the iterator ends; a device and the scene never end.

    Raises SourceError here when `source` cannot be opened, and in the iterator when it can be read no longer.
    Both may take as long as a device or a disk pleases.
    """
    if source == SYNTHETIC:
        return _synthetic(seed, size_hw or _DEFAULT_SCENE_HW)
    if source.isascii() and source.isdigit():
        return _device(int(source), size_hw)
    path = Path(source).expanduser()
    if not path.exists():
        raise SourceError(
            f"'{source}' is neither '{SYNTHETIC}', nor the number of a device, "
            "nor a file or folder that exists."
        )
    if path.is_dir() or path.suffix.lower() in PICTURE_SUFFIXES:
        paths = picture_paths(path)
        return PictureSource(_pictures(itertools.cycle(paths) if loop else paths, size_hw), PICTURE_RATE_HZ)
    return _video(path, size_hw, loop)


def _synthetic(seed: int, size_hw: tuple[int, int]) -> PictureSource:
    try:
        scene = Scene(seed, size_hw)
    except ValueError as error:
        raise SourceError(str(error)) from None
    frames = (
        SourceFrame(Picture(pixels, "rgb"), truth) for pixels, truth in map(scene.frame, itertools.count())
    )
    return PictureSource(frames, PICTURE_RATE_HZ)


def _device(number: int, size_hw: tuple[int, int] | None) -> PictureSource:
    capture = cv2.VideoCapture(number)
    if not capture.isOpened():
        raise SourceError(f"Device {number} cannot be opened: is it plugged in, free, and may you read it?")
    if size_hw is not None:
        capture.set(cv2.CAP_PROP_FRAME_HEIGHT, size_hw[0])
        capture.set(cv2.CAP_PROP_FRAME_WIDTH, size_hw[1])

    def frames() -> Iterator[SourceFrame]:
        yield from _captured(capture, size_hw)
        raise SourceError(f"Device {number} gives no more pictures: was it unplugged?")

    return PictureSource(frames(), rate_hz=None)


def _video(path: Path, size_hw: tuple[int, int] | None, loop: bool) -> PictureSource:
    capture = cv2.VideoCapture(str(path))
    if not capture.isOpened():
        raise SourceError(
            f"{path} can be read neither as a picture nor as a video: "
            "copy it again, or convert it to .mp4, .jpg or .png."
        )
    told_hz = capture.get(cv2.CAP_PROP_FPS)
    rate_hz = told_hz if 0 < told_hz <= _MAX_VIDEO_RATE_HZ else PICTURE_RATE_HZ
    captured = _captured(capture, size_hw)
    first = next(captured, None)
    if first is None:
        raise SourceError(f"{path} is a video without a picture that can be read.")
    repeated = _repeated(path, size_hw) if loop else ()
    return PictureSource(itertools.chain([first], captured, repeated), rate_hz)


def _repeated(path: Path, size_hw: tuple[int, int] | None) -> Iterator[SourceFrame]:
    """The video from its beginning, over and over."""
    while True:
        # Many formats cannot go back to their beginning, all can be opened again.
        captured = _captured(cv2.VideoCapture(str(path)), size_hw)
        first = next(captured, None)
        if first is None:
            raise SourceError(f"{path} can be read no longer: was it moved or unplugged?")
        yield first
        yield from captured


def _captured(capture: cv2.VideoCapture, size_hw: tuple[int, int] | None) -> Iterator[SourceFrame]:
    try:
        while True:
            is_read, pixels = capture.read()
            if not is_read:
                return
            yield SourceFrame(Picture(_sized(np.asarray(pixels, np.uint8), size_hw), "bgr"))
    finally:
        capture.release()


def picture_paths(path: Path) -> list[Path]:
    """`path` itself, or the pictures in that folder as a person would sort them; SourceError without any."""
    if not path.is_dir():
        return [path]
    found = (file for file in path.iterdir() if file.suffix.lower() in PICTURE_SUFFIXES)
    paths = sorted(found, key=_natural_order)
    if not paths:
        raise SourceError(f"The folder {path} has no pictures ({', '.join(PICTURE_SUFFIXES)}).")
    return paths


def _natural_order(path: Path) -> list[tuple[str, int]]:
    """9.png comes before 10.png."""
    pairs = re.findall(r"(\D*)(\d*)", path.name)
    return [(text, int(number or 0)) for text, number in pairs]


def _pictures(paths: Iterable[Path], size_hw: tuple[int, int] | None) -> Iterator[SourceFrame]:
    for path in paths:
        try:
            pixels = cv2.imread(str(path), cv2.IMREAD_COLOR)
        except cv2.error as error:
            raise SourceError(f"{path}: OpenCV refuses the picture: {error.err}.") from None
        if pixels is None:
            raise SourceError(f"{path} cannot be read as a picture: replace it, or take it away.")
        yield SourceFrame(Picture(_sized(np.asarray(pixels, np.uint8), size_hw), "bgr"))


def _sized(pixels: NDArray[np.uint8], size_hw: tuple[int, int] | None) -> NDArray[np.uint8]:
    if size_hw is None or pixels.shape[:2] == size_hw:
        return pixels
    return np.asarray(cv2.resize(pixels, size_hw[::-1], interpolation=cv2.INTER_AREA), np.uint8)
