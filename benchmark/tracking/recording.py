"""Recordings of scenes with known identities: detections and ground truth of each image."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from benchmark.tracking.camera_path import DURATION_S, SIZE_HW
from benchmark.tracking.film import Film
from benchmark.tracking.scenes import MIN_VISIBLE, TrackScene, View
from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.detection.nms import suppress
from yolov5_lifecycle.images.image import ColourImage
from yolov5_lifecycle.sources.scene import CLASS_NAMES, Shape
from yolov5_lifecycle.tracking.camera_motion import CameraMotion
from yolov5_lifecycle.tracking.motion import Similarity

START_S = 1.7e9
"""The stamp of the first image, as large as the clock's."""
MIN_SCORE = 0.1
_JITTER = 0.25  # of the time between two images, to both sides
_DROPPED = 0.05  # of the images
_PAUSE_EVERY_S = 1.5
_PAUSE_S = (0.2, 0.6)
_MISSED = 0.2  # of the objects in each image
_FALSE_PER_IMAGE = 0.4
_BOX_NOISE = 0.04  # of the box's size


@dataclass(frozen=True, eq=False)
class RecordedFrame:
    """One image: its stamp, what a detector found, and the true objects."""

    stamp_s: float
    detections: Detections
    truth_ids: tuple[int, ...]
    truth_boxes_xyxy: NDArray[np.float32]
    camera: Similarity | None = None
    """What `CameraMotion` found, None without images."""


def recorded(
    scene: TrackScene, rate_hz: float, rng: np.random.Generator, film: Film | None = None
) -> list[RecordedFrame]:
    """The `scene` at about `rate_hz`, with jitter and dropped images.

    An object that left the image and comes back counts as another one.
    """
    frames = []
    visits, motion = _Visits(scene), CameraMotion()
    for time_s in _times_s(scene, rate_hz, rng):
        view = scene.view(time_s)
        truth_ids = visits.identities(view)
        there = view.visible >= MIN_VISIBLE
        detections, camera = _detected(view, rng), None
        if film is not None:
            image = ColourImage(scene.image(view, film.background(scene.camera(time_s))), "rgb")
            camera = motion.since_last(image, detections.boxes_xyxy)
        frames.append(
            RecordedFrame(
                START_S + time_s,
                detections,
                tuple(number for number, is_there in zip(truth_ids, there, strict=True) if is_there),
                view.boxes_xyxy[there],
                camera,
            )
        )
    return frames


def _detected(view: View, rng: np.random.Generator) -> Detections:
    """What a detector finds that misses a fifth, invents objects, and scores covered objects lower."""
    found = view.visible >= MIN_VISIBLE
    visible = view.visible[found]
    scores = 0.85 * visible + rng.normal(0, 0.08, len(visible))
    class_ids = np.array([shape.class_id for shape in view.shapes], np.int64)[found]
    boxes = _shaken(view.boxes_xyxy[found], _BOX_NOISE * (2 - visible), rng)
    false_boxes, false_scores, false_ids = _false_objects(rng)
    detections = _after_nms(
        np.concatenate((boxes, false_boxes)),
        np.concatenate((scores, false_scores)),
        np.concatenate((class_ids, false_ids)),
    )
    kept = rng.random(len(detections)) >= _MISSED
    return Detections(detections.boxes_xyxy[kept], detections.scores[kept], detections.class_ids[kept])


def _times_s(scene: TrackScene, rate_hz: float, rng: np.random.Generator) -> Sequence[float]:
    times_s = np.arange(round(DURATION_S * rate_hz)) / rate_hz
    times_s = times_s + rng.uniform(-_JITTER, _JITTER, len(times_s)) / rate_hz
    is_kept = rng.random(len(times_s)) >= _DROPPED
    if scene.has_pauses:
        for start_s in np.arange(_PAUSE_EVERY_S, DURATION_S, _PAUSE_EVERY_S) + rng.uniform(-0.5, 0.5):
            is_kept &= (times_s < start_s) | (times_s > start_s + rng.uniform(*_PAUSE_S))
    kept: list[float] = times_s[is_kept].tolist()
    return kept


class _Visits:
    """Gives an actor another identity each time that it comes into the image."""

    def __init__(self, scene: TrackScene) -> None:
        self._numbers = list(range(len(scene.actors)))
        self._was_out = [False] * len(scene.actors)
        self._count = len(scene.actors)

    def identities(self, view: View) -> list[int]:
        """The identity of each shape of `view`, the next in time."""
        for row, shape in enumerate(view.shapes):
            is_out = _is_out(shape)
            if self._was_out[row] and not is_out:
                self._numbers[row] = self._count
                self._count += 1
            self._was_out[row] = is_out
        return list(self._numbers)


def _is_out(shape: Shape) -> bool:
    corners = shape.outline()
    return bool((corners.max(axis=0) <= 0).any() or (corners.min(axis=0) >= SIZE_HW[::-1]).any())


def _shaken(
    boxes_xyxy: NDArray[np.float32], noise: NDArray[np.float64], rng: np.random.Generator
) -> NDArray[np.float32]:
    """The boxes (n, 4) with `noise` (n,), in box sizes, on each side."""
    sides = boxes_xyxy[:, 2:] - boxes_xyxy[:, :2]
    shaken = boxes_xyxy + rng.normal(0, 1, boxes_xyxy.shape) * noise[:, None] * np.tile(sides, 2)
    return np.concatenate(
        (np.minimum(shaken[:, :2], shaken[:, 2:]), np.maximum(shaken[:, :2], shaken[:, 2:])), axis=1
    ).astype(np.float32)


def _false_objects(
    rng: np.random.Generator,
) -> tuple[NDArray[np.float32], NDArray[np.float64], NDArray[np.int64]]:
    count = rng.poisson(_FALSE_PER_IMAGE)
    height, width = SIZE_HW
    centres = rng.uniform((0, 0), (width, height), (count, 2))
    half_sides = rng.uniform(10, 50, (count, 2))
    boxes = np.concatenate((centres - half_sides, centres + half_sides), axis=1).astype(np.float32)
    return boxes, rng.uniform(0.1, 0.6, count), rng.integers(0, len(CLASS_NAMES), count)


def _after_nms(
    boxes_xyxy: NDArray[np.float32], scores: NDArray[np.float64], class_ids: NDArray[np.int64]
) -> Detections:
    clipped = np.clip(scores, 0, 1).astype(np.float32)
    order = np.argsort(-clipped, kind="stable")
    order = order[clipped[order] > MIN_SCORE]
    boxes_xyxy, clipped, class_ids = boxes_xyxy[order], clipped[order], class_ids[order]
    kept = suppress(boxes_xyxy, groups=class_ids, iou_threshold=0.45, limit=1000)
    return Detections(boxes_xyxy[kept], clipped[kept], class_ids[kept])
