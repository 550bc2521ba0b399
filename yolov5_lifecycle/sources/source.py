"""Image sources: a synthetic scene, a device, a stream, a video or image files."""

from __future__ import annotations

import itertools
import os
import re
from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.folder_listing import entries
from yolov5_lifecycle.images.compressed import decode_image_file
from yolov5_lifecycle.images.image import MAX_SIDE_PX, ColourImage, ImageError
from yolov5_lifecycle.input_file import RegularFileError, read_regular_file
from yolov5_lifecycle.printable import in_one_line, is_utf8
from yolov5_lifecycle.process.environment import MAX_COMPRESSED_PX
from yolov5_lifecycle.sources.frames import ImageSource, SourceError, SourceFrame
from yolov5_lifecycle.sources.network_stream import (
    Report,
    Wait,
    captured,
    check_backend,
    is_stream,
    open_stream,
    sleep,
)
from yolov5_lifecycle.sources.scene import Scene
from yolov5_lifecycle.sources.scene_depth import SceneDepth

SYNTHETIC = "synthetic"
READABLE_SUFFIXES = (".jpg", ".jpeg", ".png", ".bmp", ".webp")
IMAGE_SUFFIXES = (*READABLE_SUFFIXES, ".tif", ".tiff")  # the latter are refused with the remedy
_DEVICE = re.compile(r"(?:/dev/video)?([0-9]{1,9})")
IMAGE_RATE_HZ = 30.0
"""Default rate for sources without their own."""
_MAX_VIDEO_RATE_HZ = 1000.0
_MAX_FILE_BYTES = 8 * MAX_COMPRESSED_PX
"""No image has more: 16 bits in four channels, not compressed."""
_DEMUXERS = "mov,avi,matroska,flv,mpegts,mpeg,ogg,asf,gif"
"""FFmpeg's formats of one video in one file. Others, which it finds in a file of any name, are lists of other
files and addresses, patterns of names, images and scripts."""
_FFMPEG_OPTIONS = "OPENCV_FFMPEG_CAPTURE_OPTIONS"
_DEFAULT_SCENE_HW = (480, 640)
_MAX_REPORTED = 10
"""Number of skipped images that are reported by name; further ones are only counted."""


def open_source(
    source: str,
    *,
    size_hw: tuple[int, int] | None = None,
    seed: int = 0,
    depth: bool = False,
    loop: bool = True,
    report: Report = lambda problem: None,
    wait: Wait = sleep,
) -> ImageSource:
    """Open `source`: "synthetic", a device, a URL, a GStreamer pipeline, a video, an image or a folder.

    Every image is resized to `size_hw`; None keeps the size of the source (the scene: 480 x 640). With
    `loop`, files restart at their end and a stream is reconnected; otherwise the iterator ends. A device and
    the scene never end. `depth` adds the depth of the scene; no other source has any. `report` receives
    problems that do not end the source: skipped images of a folder, a lost stream. `wait` is called before a
    stream is reconnected.

    Raises SourceError here when `source` cannot be opened, and in the iterator when it becomes unreadable.
    Both may block for as long as the device or disk takes.
    """
    if source == SYNTHETIC:
        return _synthetic(seed, size_hw or _DEFAULT_SCENE_HW, depth)
    if not is_utf8(source):  # OpenCV 5.0 crashes
        raise SourceError(f"{in_one_line(source)}: the path or address of a source must be UTF-8; rename it.")
    if device := _DEVICE.fullmatch(os.path.realpath(source) if "/" in source else source):
        return _device(int(device[1]), size_hw)
    path = Path(source).expanduser()
    exists = os.path.exists(path)  # noqa: PTH110 - Path.exists raises if the name is too long
    if exists and path.is_char_device():  # a terminal or a serial port would be waited for
        raise SourceError(f"{in_one_line(source)} is a device, but not a camera.{_devices()}")
    if is_stream(source) and not exists:
        frames, rate_hz = open_stream(source, reconnects=loop, report=report, wait=wait)
        return ImageSource((_frame(pixels, size_hw) for pixels in frames), rate_hz)
    if not exists:
        before, _, after = source.rpartition("@")  # an address without its scheme has a password, too
        shown = in_one_line(f"***@{after}" if ":" in before else source)
        raise SourceError(
            f"'{shown}' is neither '{SYNTHETIC}', nor the number of a device, nor a URL, "
            "nor an existing file or folder."
        )
    if path.is_dir() or path.suffix.lower() in IMAGE_SUFFIXES:
        return ImageSource(_images(image_paths(path), size_hw, loop, report), IMAGE_RATE_HZ)
    return _video(path, size_hw, loop)


def _devices() -> str:
    found = sorted(Path("/dev").glob("video[0-9]*"), key=_natural_order)
    return f" There are: {', '.join(map(str, found))}." if found else " There is no /dev/video* here."


def _synthetic(seed: int, size_hw: tuple[int, int], with_depth: bool) -> ImageSource:
    try:
        scene = Scene(seed, size_hw)
    except ValueError as error:
        raise SourceError(str(error)) from None
    space = SceneDepth(seed, scene) if with_depth else None

    def frame(index: int) -> SourceFrame:
        pixels = scene.image(index)
        depth = space.frame(index) if space else None
        return SourceFrame(ColourImage(pixels, "rgb"), scene.shapes(index), depth)

    return ImageSource(map(frame, itertools.count()), IMAGE_RATE_HZ)


def _device(number: int, size_hw: tuple[int, int] | None) -> ImageSource:
    capture = cv2.VideoCapture(number)
    if not capture.isOpened():
        raise SourceError(
            f"Device {number} cannot be opened: is it plugged in and free, and may you read it?{_devices()}"
        )
    if size_hw is not None:
        capture.set(cv2.CAP_PROP_FRAME_HEIGHT, size_hw[0])
        capture.set(cv2.CAP_PROP_FRAME_WIDTH, size_hw[1])

    def frames() -> Iterator[SourceFrame]:
        yield from (_frame(pixels, size_hw) for pixels in captured(capture))
        raise SourceError(f"Device {number} delivers no more images: was it unplugged?")

    return ImageSource(frames(), rate_hz=None)


def _video(path: Path, size_hw: tuple[int, int] | None, loop: bool) -> ImageSource:
    capture = _opened(path)
    if not capture.isOpened():
        raise SourceError(
            f"{path} can be read neither as an image nor as a video, for which a list of other files is not "
            "taken: copy it again, or convert it to .mp4, .jpg or .png."
        )
    sides = capture.get(cv2.CAP_PROP_FRAME_WIDTH), capture.get(cv2.CAP_PROP_FRAME_HEIGHT)
    if max(sides) > MAX_SIDE_PX:
        capture.release()
        raise SourceError(
            f"{path}: expected at most {MAX_SIDE_PX} pixels a side, found {sides[0]:g} x {sides[1]:g}."
        )
    claimed_frames = max(int(capture.get(cv2.CAP_PROP_FRAME_COUNT)), 0)
    told_hz = capture.get(cv2.CAP_PROP_FPS)
    rate_hz = told_hz if 0 < told_hz <= _MAX_VIDEO_RATE_HZ else IMAGE_RATE_HZ
    once = _first_and_others(capture, f"{path} is a video without a readable image.")
    # Many formats cannot seek to the beginning, all can be reopened.
    lost = f"{path} can no longer be read: was it moved or unplugged?"
    again = (pixels for _ in itertools.repeat(None) for pixels in _first_and_others(_opened(path), lost))
    frames = (_frame(pixels, size_hw) for pixels in itertools.chain(once, again if loop else ()))
    return ImageSource(frames, rate_hz, claimed_frames)


def _first_and_others(capture: cv2.VideoCapture, problem: str) -> Iterator[NDArray[np.uint8]]:
    """The frames of `capture`; SourceError, at once, if it has none."""
    frames = captured(capture)
    if (first := next(frames, None)) is None:
        raise SourceError(problem)
    return itertools.chain([first], frames)


def _opened(path: Path) -> cv2.VideoCapture:
    """The video of one file, opened or not."""
    check_backend(cv2.CAP_FFMPEG, "videos", "FFmpeg")
    given = os.environ.get(_FFMPEG_OPTIONS)
    own = f"format_whitelist;{_DEMUXERS}|protocol_whitelist;file"
    os.environ[_FFMPEG_OPTIONS] = "|".join(filter(None, (given, own)))  # OpenCV has no other way
    try:
        return cv2.VideoCapture(str(path.absolute()), cv2.CAP_FFMPEG)
    finally:
        del os.environ[_FFMPEG_OPTIONS]
        if given is not None:
            os.environ[_FFMPEG_OPTIONS] = given


def image_paths(path: Path) -> list[Path]:
    """`path` itself, or the images in that folder in natural order; SourceError if it has none."""
    if not path.is_dir():
        return [path]
    found = (file for file in entries(path) if file.suffix.lower() in IMAGE_SUFFIXES)
    try:
        paths = sorted(found, key=_natural_order)
    except OSError as error:
        raise SourceError(str(error)) from None
    if not paths:
        inner = min((folder for folder in entries(path) if folder.is_dir()), default=None)
        remedy = f" Name one of the folders in it, such as {inner}." if inner else ""
        raise SourceError(f"The folder {path} has no images ({', '.join(READABLE_SUFFIXES)}).{remedy}")
    return paths


def _natural_order(path: Path) -> list[tuple[str, int]]:
    """Sort key of natural order: 9.png comes before 10.png."""
    pairs = re.findall(r"(\D*)(\d*)", path.name)
    return [(text, int(number or 0)) for text, number in pairs]


def _images(
    paths: Sequence[Path], size_hw: tuple[int, int] | None, loop: bool, report: Report
) -> Iterator[SourceFrame]:
    """Image files in order; with `loop`, endlessly. Of several, unreadable ones are skipped."""
    skipped: set[Path] = set()
    for number, path in enumerate(itertools.cycle(paths) if loop else paths, start=1):
        try:
            frame = _frame(read_image(path).pixels, size_hw)
        except SourceError as error:
            if len(paths) == 1:
                raise
            if path not in skipped and len(skipped) < _MAX_REPORTED:
                report(f"skipped: {error}")
            skipped.add(path)
            if len(skipped) == len(paths):
                raise SourceError(f"None of the {len(paths)} images can be read.") from None
        else:
            skipped.discard(path)
            yield frame
        if number == len(paths) and skipped:
            report(f"{len(skipped)} of {len(paths)} images were skipped.")


def read_image(path: Path) -> ColourImage:
    """The image of a regular file, upright; raises SourceError."""
    try:
        data = np.frombuffer(read_regular_file(path, _MAX_FILE_BYTES), np.uint8)
        return decode_image_file(data)
    except (OSError, RegularFileError, ImageError) as error:
        raise SourceError(f"{path} cannot be read as an image: replace or remove it. {error}") from None


def _frame(pixels: NDArray[np.uint8], size_hw: tuple[int, int] | None) -> SourceFrame:
    if size_hw not in (None, pixels.shape[:2]):
        pixels = np.asarray(cv2.resize(pixels, size_hw[::-1], interpolation=cv2.INTER_AREA), np.uint8)
    return SourceFrame(ColourImage(pixels, "bgr"))
