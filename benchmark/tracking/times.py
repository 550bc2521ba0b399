"""How long an update of the tracker and the motion of a camera take."""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterator

import numpy as np

from benchmark.report import Row, row
from benchmark.tracking.camera_path import CAMERA_PATHS, SIZE_HW
from benchmark.tracking.cases import SETTINGS
from benchmark.tracking.film import Film
from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.images.image import ColourImage
from yolov5_lifecycle.tracking.byte_tracker import ByteTracker
from yolov5_lifecycle.tracking.camera_motion import CameraMotion

_SIZES = ((*SIZE_HW, 100), (1080, 1920, 100), (6000, 10000, 25))
"""Height, width, images."""


def time_rows() -> list[Row]:
    """Of an update with 50, 10 and 1000 objects; of the motion of a camera in images of three sizes."""
    rng = np.random.default_rng(0)
    updates = [
        row("update", f"{count} objects", 0, update_times_ms(count, frames, rng)[5:])
        for count, frames in ((50, 300), (10, 300), (1000, 30))
    ]
    return updates + [
        row("camera", f"{width} x {height}", 0, camera_times_ms((height, width), count, rng)[5:])
        for height, width, count in _SIZES
    ]


def update_times_ms(count: int, frames: int, rng: np.random.Generator) -> list[float]:
    """Milliseconds of each update with `count` moving objects, a tenth of them with a low score."""
    height, width = SIZE_HW
    centres = rng.uniform((0, 0), (width * 3, height * 3), (count, 2))
    half_sides = rng.uniform(15, 50, (count, 2))
    speeds = rng.uniform(-60, 60, (count, 2))
    scores = np.sort(rng.uniform(0.2, 0.9, count))[::-1].astype(np.float32)
    tracker = ByteTracker(itertools.count(1))
    times_ms = []
    for number in range(frames):
        places = centres + speeds * number / 30 + rng.normal(0, 1, (count, 2))
        boxes = np.concatenate((places - half_sides, places + half_sides), axis=1).astype(np.float32)
        found = Detections(boxes, scores, np.zeros(count, np.int64))
        begun_s = time.perf_counter()
        tracker.update(found, stamp_s=number / 30, settings=SETTINGS)
        times_ms.append(1000 * (time.perf_counter() - begun_s))
    return times_ms


def camera_times_ms(size_hw: tuple[int, int], count: int, rng: np.random.Generator) -> list[float]:
    """Milliseconds for the motion of a camera that sways, in each of `count` images of `size_hw`."""
    motion, boxes_xyxy = CameraMotion(), np.array(((0.2, 0.2, 0.4, 0.6),)) * np.tile(size_hw[::-1], 2)
    times_ms = []
    for image in _swaying(size_hw, count, rng):
        begun_s = time.perf_counter()
        motion.since_last(image, boxes_xyxy)
        times_ms.append(1000 * (time.perf_counter() - begun_s))
    return times_ms


def _swaying(size_hw: tuple[int, int], count: int, rng: np.random.Generator) -> Iterator[ColourImage]:
    """Images at 10 Hz, small ones enlarged to `size_hw`."""
    film, path = Film(rng), CAMERA_PATHS["sway 40 0.4"](rng)
    repeats = -(-size_hw[0] // SIZE_HW[0]), -(-size_hw[1] // SIZE_HW[1])
    for number in range(count):
        pixels = film.background(path(number / 10))
        large = pixels.repeat(repeats[0], axis=0).repeat(repeats[1], axis=1)
        yield ColourImage(large[: size_hw[0], : size_hw[1]], "rgb")
