"""How much an image looks like those that are kept."""

from __future__ import annotations

import math
from contextlib import suppress

import numpy as np
from numpy.typing import NDArray

MIN_ROWS = 256


class KeptEmbeddings:
    """Embeddings of length 1 by the path of their image; of another model, of other length, they differ."""

    def __init__(self) -> None:
        self._rows: dict[int, _Rows] = {}

    def add(self, image: str, embedding: NDArray[np.float32]) -> None:
        """Remember `embedding` (C,), of length 1; one of no numbers is left out."""
        if len(embedding):
            self._rows.setdefault(len(embedding), _Rows(len(embedding))).add(image, embedding)

    def remove(self, image: str) -> None:
        for rows in self._rows.values():
            with suppress(KeyError):
                rows.remove(image)

    def distance(self, embedding: NDArray[np.float32]) -> float:
        """The least cosine distance, in [0, 2], of `embedding` (C,) to those kept; infinite without any."""
        rows, length = self._rows.get(len(embedding)), float(np.linalg.norm(embedding))
        if rows is None or not len(rows) or not np.isfinite(length) or length == 0:
            return math.inf
        return max(1 - rows.highest_product(embedding / np.float32(length)), 0.0)


class _Rows:
    """An array (n, C) that grows; a removed row is filled with the last one."""

    def __init__(self, columns: int) -> None:
        self._array = np.empty((MIN_ROWS, columns), np.float32)
        self._images: list[str] = []
        self._index: dict[str, int] = {}

    def __len__(self) -> int:
        return len(self._images)

    def add(self, image: str, row: NDArray[np.float32]) -> None:
        if len(self) == len(self._array):
            self._array = np.concatenate([self._array, np.empty_like(self._array)])
        self._array[len(self)] = row
        self._index[image] = len(self)
        self._images.append(image)

    def remove(self, image: str) -> None:
        """Raises KeyError."""
        index, last = self._index.pop(image), self._images.pop()
        if last != image:
            self._array[index] = self._array[len(self)]
            self._images[index] = last
            self._index[last] = index

    def highest_product(self, row: NDArray[np.float32]) -> float:
        return float((self._array[: len(self)] @ row).max())
