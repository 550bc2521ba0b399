"""Random ground truth and detections of it, some right, some wrong."""

from __future__ import annotations

import numpy as np

from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.evaluation.ground_truth import Boxes
from yolov5_lifecycle.evaluation.matching import EvaluatedImage

CLASS_NAMES = ("cat", "dog", "bird")
SIZE_HW = (400, 500)


def random_images(
    seed: int, count: int, *, classes: int = len(CLASS_NAMES), crowds: float = 0.0, noise: float = 12.0
) -> list[EvaluatedImage]:
    """`count` images with 0 to 6 objects; a share `crowds` of these surrounds many."""
    rng = np.random.default_rng(seed)
    return [_random_image(rng, number, classes, crowds, noise) for number in range(count)]


def _random_image(
    rng: np.random.Generator, number: int, classes: int, crowds: float, noise: float
) -> EvaluatedImage:
    objects = int(rng.integers(0, 7))
    corners = rng.uniform(0, 300, (objects, 2))
    xyxy = np.concatenate((corners, corners + rng.uniform(20, 100, (objects, 2))), axis=1)
    class_ids = rng.integers(0, classes, objects)
    truth = Boxes(xyxy, class_ids, rng.random(objects) < crowds)
    copied = rng.integers(0, objects, rng.integers(0, 2 * objects + 1)) if objects else np.zeros(0, np.int64)
    found = np.sort((xyxy[copied] + rng.normal(0, noise, (len(copied), 4))).reshape(-1, 2, 2), axis=1)
    others = rng.integers(0, classes, len(copied))
    found_ids = np.where(rng.random(len(copied)) < 0.75, class_ids[copied], others)
    scores = np.sort(rng.random(len(copied)).astype(np.float32))[::-1]
    detections = Detections(found.reshape(-1, 4).astype(np.float32), scores, found_ids)
    return EvaluatedImage(f"{number}.png", SIZE_HW, truth, detections)
