"""Frames that may be collected, with the rules of a test's model of cats and dogs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.collecting.candidate import Candidate, CollectRules, Detail, Origin, Pace, Trigger
from yolov5_lifecycle.collecting.collected_files import (
    CollectedFrame,
    CollectedObject,
    KeptImage,
    embedding_text,
    kept_images,
    shades_text,
)
from yolov5_lifecycle.collecting.collected_folder import CollectedFolder
from yolov5_lifecycle.collecting.descriptors import SHADES
from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.detection.nms import Selection
from yolov5_lifecycle.images.image import ColourImage
from yolov5_lifecycle.settings.settings import Settings

CLASS_NAMES = ("cat", "dog")
SIZE_HW = (48, 64)


def rules(**changes: Any) -> CollectRules:
    """The rules of a camera with default settings; `changes` to these and to them, those of settings without
    their `collect_`."""
    of_settings = {
        name: changes.pop(name) for name in ("reasons", "per_minute", "blank_regions") if name in changes
    }
    usual = CollectRules(
        settings=Settings(**{f"collect_{name}": value for name, value in of_settings.items()}),
        selection=Selection(),
        camera="",
        class_names=CLASS_NAMES,
        segments=False,
        weights_sha256="ab" * 32,
    )
    return replace(usual, **changes)


def found(*objects: tuple[str, float, tuple[float, ...]]) -> Detections:
    """Detections from class name, score and box each, highest score first."""
    return Detections(
        np.array([box for *_, box in objects], np.float32).reshape(-1, 4),
        np.array([score for _, score, _ in objects], np.float32),
        np.array([CLASS_NAMES.index(name) for name, *_ in objects], np.int64),
    )


CAT = found(("cat", 0.9, (10, 10, 30, 40)))


def look_of(seed: int) -> NDArray[np.float32]:
    """What an image looks like to a network: far from that of any other seed."""
    return np.random.default_rng(seed).normal(size=64).astype(np.float32)


RECORD = CollectedFrame(
    image="images/20261124T070343Z-0a1b2c/000001_front.jpg",
    camera="front",
    frame_id='optical "frame"\n',
    sec=1,
    nanosec=2,
    size_wh=(64, 48),
    weights_sha256="ab" * 32,
    configuration="0123456789ab",
    reasons={"uncertain": "cat 0.26, threshold 0.25"},
    value=2.0,
    objects=(CollectedObject(class_name="cat", score=0.9, box_xyxy=(1.5, 2, 3, 4), track_id="7"),),
    embedding=embedding_text(look_of(0)),
    shades=shades_text(np.zeros(SHADES, np.int8)),
)


def candidate(seed: int = 0, **changes: Any) -> Candidate:
    """A frame of a cat, worth keeping because somebody asked for one of its class."""
    pixels = np.random.default_rng(seed).integers(0, 255, (*SIZE_HW, 3)).astype(np.uint8)
    usual = Candidate(
        image=ColourImage(pixels, "bgr"),
        received_jpeg=None,
        detections=CAT,
        embedding=look_of(seed),
        origin=Origin("optical_frame", 12, 34),
        reasons={Trigger.CLASS: Detail("cat")},
        rules=rules(per_minute=0.0),
        pace=Pace(),
    )
    return replace(usual, **changes)


def keep(
    folder: CollectedFolder, seed: int = 0, *, value: float = 1.0, names: tuple[str, ...] = CLASS_NAMES
) -> bool:
    """Offer the frame number `seed` to the folder, of a model with the class `names`."""
    return add(folder, candidate(seed, rules=rules(class_names=names)), value=value)


def add(folder: CollectedFolder, frame: Candidate, *, value: float | None = None) -> bool:
    """Offer the frame to the folder, with its own value or another one."""
    record = frame.record(folder.session.new_path(""), frame.reasons)
    record = record if value is None else record.model_copy(update={"value": value})
    return folder.add(record, frame.jpeg(), frame.labels(folder.ids_of(frame.rules.class_names)))


def frames_of(folder: Path) -> list[CollectedFrame]:
    """The records in `folder`, in the order in which they were kept."""
    return [frame for _, frame in kept_images(folder)]


def images_of(folder: Path) -> list[KeptImage]:
    """What is kept in `folder`, in that order."""
    return [kept for kept, _ in kept_images(folder)]
