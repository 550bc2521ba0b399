"""The command `detect_bag` with a small model that segments, whose weights are random."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from support.random_model import random_model
from support.small_families import SMALL_FAMILIES
from yolov5_lifecycle.detection.class_filter import selection_of
from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.detection.detector import Detector
from yolov5_lifecycle.detection.prepared_model import PreparedModel, load_detector
from yolov5_lifecycle.images.image import ColourImage
from yolov5_lifecycle.offline.detect_bag import main
from yolov5_lifecycle.settings.settings import Settings

COUNT = 4
"""Detections in each image, which overlap."""
SETTINGS = Settings.model_validate({"max_detections": COUNT, "iou_threshold": 0.6})
SET_MODEL = ["--set", f"max_detections={COUNT}", "--set", f"iou_threshold={SETTINGS.iou_threshold}"]


@functools.cache
def segmenting_detector() -> Detector:
    model = random_model(7, SMALL_FAMILIES["segmentation"])
    return load_detector(model, runtime="torch", device="cpu", image_size=320)


def _prepare(settings: Settings, _: Sequence[tuple[int, int]]) -> PreparedModel:
    return PreparedModel(settings, segmenting_detector(), Path("/random.pt"), "0" * 64)


segment = functools.partial(main, prepare=_prepare)


def segmented(image: ColourImage) -> Detections:
    """What the model finds in `image`, with masks."""
    detector = segmenting_detector()
    return detector.detect(image, replace(selection_of(SETTINGS, detector.class_names), with_masks=True))
