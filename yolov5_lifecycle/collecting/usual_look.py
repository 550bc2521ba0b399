"""How much an image looks unlike what its camera usually sees."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_IMAGES = 2000
"""The mean follows about this many images: it forgets what lies farther back."""
MIN_IMAGES = 20
"""With fewer nobody knows what is usual."""


class UsualLook:
    """The mean of the embeddings of a camera's images by one model, and how far from it they usually are."""

    def __init__(self) -> None:
        self._model = ""
        self._count = 0
        self._mean: NDArray[np.float32] = np.zeros(0, np.float32)
        self._usual_distance = 0.0

    def times_usual(self, embedding: NDArray[np.float32], model: str) -> float:
        """The distance of `embedding` (C,) of `model` from the mean, divided by the usual one.

        0 for one of no finite numbers or of zeros only, and until MIN_IMAGES are known. Distances are cosine
        distances. The embedding counts in the mean from now on; another model starts afresh.
        """
        length = float(np.linalg.norm(embedding))
        if not np.isfinite(length) or length == 0:
            return 0.0
        if model != self._model or len(embedding) != len(self._mean):
            self._model, self._count, self._usual_distance = model, 0, 0.0
            self._mean = np.zeros_like(embedding)
        self._count = min(self._count + 1, _IMAGES)
        self._mean += (embedding / np.float32(length) - self._mean) / np.float32(self._count)
        distance = 1 - float(embedding @ self._mean) / (length * float(np.linalg.norm(self._mean)))
        self._usual_distance += (distance - self._usual_distance) / self._count
        is_known = self._count >= MIN_IMAGES and self._usual_distance > 0
        return max(distance, 0.0) / self._usual_distance if is_known else 0.0
