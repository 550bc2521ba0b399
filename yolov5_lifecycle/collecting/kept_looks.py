"""How much an image looks like those that are kept."""

from __future__ import annotations

import math
from contextlib import suppress

import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.collecting.shades import SHADES, Shades, same_shades

MIN_ROWS = 256


class KeptLooks:
    """Embeddings of length 1 and shades by the path of their image.

    Images of another model, whose embeddings have another length, differ.
    """

    def __init__(self) -> None:
        self._rows: dict[int, _Rows] = {}

    def add(self, image: str, embedding: NDArray[np.float32], shades: Shades) -> None:
        """Remember `embedding` (C,), of length 1, and the shades; one of no numbers is left out."""
        if len(embedding):
            self._rows.setdefault(len(embedding), _Rows(len(embedding))).add(image, embedding, shades)

    def remove(self, image: str) -> None:
        for rows in self._rows.values():
            with suppress(KeyError):
                rows.remove(image)

    def distances(self, embedding: NDArray[np.float32]) -> NDArray[np.float32]:
        """The cosine distances (n,), in [0, 2], of `embedding` (C,) to those kept that it compares with."""
        rows, length = self._rows.get(len(embedding)), float(np.linalg.norm(embedding))
        if rows is None or not np.isfinite(length) or length == 0:
            return np.empty(0, np.float32)
        return np.maximum(1 - rows.products(embedding / np.float32(length)), 0)

    def distance(self, embedding: NDArray[np.float32]) -> float:
        """The least of `distances`; infinite without any."""
        return float(self.distances(embedding).min(initial=math.inf))

    def has_same_shades(self, embedding: NDArray[np.float32], shades: Shades, *, distance: float) -> bool:
        """Whether a kept image that is nearer than `distance` may show the same as `shades`."""
        near = self.distances(embedding) < distance
        return bool(near.any() and same_shades(shades, self._rows[len(embedding)].shades[near]).any())


class _Rows:
    """Arrays (n, C) and (n, SHADES) that grow; a removed row is filled with the last one."""

    def __init__(self, columns: int) -> None:
        self._embeddings = np.empty((MIN_ROWS, columns), np.float32)
        self._shades = np.empty((MIN_ROWS, SHADES), np.int8)
        self._images: list[str] = []
        self._index: dict[str, int] = {}

    def add(self, image: str, embedding: NDArray[np.float32], shades: Shades) -> None:
        row = len(self._images)
        if row == len(self._embeddings):
            self._embeddings = np.concatenate([self._embeddings, np.empty_like(self._embeddings)])
            self._shades = np.concatenate([self._shades, np.empty_like(self._shades)])
        self._embeddings[row], self._shades[row] = embedding, shades
        self._index[image] = row
        self._images.append(image)

    def remove(self, image: str) -> None:
        """Raises KeyError."""
        row, last = self._index.pop(image), self._images.pop()
        if last != image:
            self._embeddings[row] = self._embeddings[len(self._images)]
            self._shades[row] = self._shades[len(self._images)]
            self._images[row] = last
            self._index[last] = row

    @property
    def shades(self) -> NDArray[np.int8]:
        return self._shades[: len(self._images)]

    def products(self, embedding: NDArray[np.float32]) -> NDArray[np.float32]:
        """With the embeddings of all rows: (n,)."""
        return self._embeddings[: len(self._images)] @ embedding
