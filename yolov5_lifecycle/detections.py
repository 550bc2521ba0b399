"""What was found in one picture."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class Detections:
    """Objects found in one picture: a row each in every column, best score first.

    Raises ValueError at birth when a column has another shape, dtype or range than said here.
    """

    boxes_xyxy: NDArray[np.float32]
    """(n, 4) finite corners in pixels with x1 <= x2, y1 <= y2; who made them says in which frame."""
    scores: NDArray[np.float32]
    """(n,) in [0, 1]."""
    class_ids: NDArray[np.int64]
    """(n,) indices into the model's class names."""
    best_missed: float = 0.0
    """When nothing was found: the highest score that was too low, 0 if none was worth telling."""

    def __post_init__(self) -> None:
        count = len(self.scores)
        _check("boxes_xyxy", self.boxes_xyxy, (count, 4), np.float32)
        _check("scores", self.scores, (count,), np.float32)
        _check("class_ids", self.class_ids, (count,), np.int64)
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


def _check(column: str, values: NDArray[np.generic], shape: tuple[int, ...], dtype: type[np.generic]) -> None:
    if values.shape != shape or values.dtype != dtype:
        expected = f"{np.dtype(dtype)} of shape {shape}"
        raise ValueError(f"{column} must be {expected}, found {values.dtype} of shape {values.shape}.")
