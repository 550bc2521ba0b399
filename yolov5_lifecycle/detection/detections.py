"""Detections of one image, as arrays and as objects."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.detection.masks import Masks


@dataclass(frozen=True, eq=False)
class Detections:
    """Detections of one image as parallel arrays, one row per object, highest score first.

    Raises ValueError on construction when an array has another shape, dtype or range than documented here.
    """

    boxes_xyxy: NDArray[np.float32]
    """(n, 4) finite corners in pixels, x1 <= x2 and y1 <= y2; the producer defines the coordinates."""
    scores: NDArray[np.float32]
    """(n,) in [0, 1]."""
    class_ids: NDArray[np.int64]
    """(n,) indices into the model's class names."""
    best_missed: float = 0.0
    """Without detections: the highest score below the threshold, 0 if none was worth reporting."""
    track_ids: tuple[str, ...] = ()
    """(n,) identities, "" where there is none; empty without a tracker."""
    masks: Masks | None = None
    """Masks of the n detections; None unless the model segments and masks were requested."""
    best_filtered: float = 0.0
    """The highest score above the threshold, of a box that does not count; 0 if there is none."""
    embedding: NDArray[np.float32] | None = None
    """(C,) what the whole image looks like to the network; None unless it was requested."""

    def __post_init__(self) -> None:
        count = len(self.scores)
        _check("boxes_xyxy", self.boxes_xyxy, (count, 4), np.float32)
        _check("scores", self.scores, (count,), np.float32)
        _check("class_ids", self.class_ids, (count,), np.int64)
        if len(self.track_ids) not in (0, count):
            raise ValueError(f"track_ids must be none or {count}, found {len(self.track_ids)}.")
        if self.masks is not None and len(self.masks) != count:
            raise ValueError(f"masks must be of {count} detections, found {len(self.masks)}.")
        if not np.isfinite(self.boxes_xyxy).all():
            raise ValueError("boxes_xyxy must be finite, found NaN or infinity.")
        if (self.boxes_xyxy[:, :2] > self.boxes_xyxy[:, 2:]).any():
            raise ValueError("boxes_xyxy must have x1 <= x2 and y1 <= y2, found corners exchanged.")
        if not ((self.scores >= 0) & (self.scores <= 1)).all():
            raise ValueError(f"scores must be in [0, 1], found {self.scores.min()} to {self.scores.max()}.")
        if (self.scores[1:] > self.scores[:-1]).any():
            raise ValueError("scores must come best first, found a better one after a worse one.")
        if (self.class_ids < 0).any():
            raise ValueError(f"class_ids must not be negative, found {self.class_ids.min()}.")

    def __len__(self) -> int:
        return len(self.scores)

    def __getitem__(self, rows: slice | NDArray[np.bool_] | NDArray[np.int64]) -> Detections:
        """Some rows, in their order: a slice, a mask (n,) or ascending indices."""
        kept = np.arange(len(self))[rows]
        return Detections(
            self.boxes_xyxy[kept],
            self.scores[kept],
            self.class_ids[kept],
            self.best_missed,
            track_ids=tuple(self.track_ids[row] for row in kept) if self.track_ids else (),
            masks=None if self.masks is None else self.masks.of(kept),
            best_filtered=self.best_filtered,
            embedding=self.embedding,
        )

    def label_image(self) -> NDArray[np.uint16] | None:
        """Which pixels belong to which detection, see `Masks.label_image`; None without masks."""
        return None if self.masks is None else self.masks.label_image(self.boxes_xyxy)

    def objects(self, class_names: Sequence[str]) -> list[FoundObject]:
        """The rows as objects with their class names, highest score first."""
        ids = self.track_ids or ("",) * len(self)
        rows = zip(self.class_ids.tolist(), self.scores.tolist(), self.boxes_xyxy.tolist(), ids, strict=True)
        return [
            FoundObject(class_names[class_id], score, tuple(box), track_id)
            for class_id, score, box, track_id in rows
        ]


def _check(column: str, values: NDArray[np.generic], shape: tuple[int, ...], dtype: type[np.generic]) -> None:
    if values.shape != shape or values.dtype != dtype:
        expected = f"{np.dtype(dtype)} of shape {shape}"
        raise ValueError(f"{column} must be {expected}, found {values.dtype} of shape {values.shape}.")


@dataclass(frozen=True)
class FoundObject:
    """One detection: class name, score in [0, 1], box in image pixels, and "" or the id of its track."""

    class_name: str
    score: float
    box_xyxy: tuple[float, float, float, float]
    track_id: str = ""

    @property
    def centre_xy(self) -> tuple[float, float]:
        x1, y1, x2, y2 = self.box_xyxy
        return (x1 + x2) / 2, (y1 + y2) / 2

    @property
    def size_xy(self) -> tuple[float, float]:
        """Width and height."""
        x1, y1, x2, y2 = self.box_xyxy
        return x2 - x1, y2 - y1
