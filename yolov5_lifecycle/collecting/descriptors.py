"""What an image looks like to the network, and where it is bright or dark, compared with other images."""

from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.images.image import ColourImage

DUPLICATE_DISTANCE = 0.002
"""Cosine distance below which two images show the same, unless their shades differ."""
_SIDE = 16
SHADES = _SIDE * _SIDE
_ENOUGH_PX = 256
"""Rows or columns of an image that are read: an average of more is no better."""
_STEPS = 32
"""In a standard deviation."""
_SAME = 1.0
"""Standard deviations by which no part of two images of the same may differ."""
MIN_ROWS = 256
_USUAL_IMAGES = 2000
"""The mean follows about this many images: it forgets what lies farther back."""
MIN_IMAGES = 20
"""With fewer nobody knows what is usual."""

Embedding = NDArray[np.float32]
"""(C,) see `Detections.embedding`."""
Shades = NDArray[np.int8]
"""(SHADES,) brightness of 16x16 parts of an image: steps of 1/32 standard deviation, from their mean."""


def unit(embedding: Embedding) -> Embedding | None:
    """`embedding` with length 1; None if it is empty, all zeros or not finite."""
    length = np.linalg.norm(embedding)
    return embedding / length if np.isfinite(length) and length > 0 else None


def shades_of(image: ColourImage) -> Shades:
    """The shades of `image`. A change of the exposure does not change them."""
    step = max(min(image.size_hw) // _ENOUGH_PX, 1)
    parts = cv2.resize(image.pixels[::step, ::step], (_SIDE, _SIDE), interpolation=cv2.INTER_AREA)
    brightness = parts.astype(np.float32).mean(axis=2).ravel()
    deviations = (brightness - brightness.mean()) / max(float(brightness.std()), 1e-3)
    return np.asarray(np.clip(np.rint(deviations * _STEPS), -128, 127), np.int8)


def same_shades(shades: Shades, others: NDArray[np.int8]) -> NDArray[np.bool_]:
    """Whether each of `others` (n, SHADES) may show the same as `shades`: (n,)."""
    differences = np.abs(others.astype(np.int16) - shades.astype(np.int16))
    return np.asarray(differences.max(axis=1, initial=0) < _SAME * _STEPS, np.bool_)


class KeptDescriptors:
    """Embeddings of length 1 and shades by the path of their image.

    Images of another model, whose embeddings have another length, differ.
    """

    def __init__(self) -> None:
        self._rows: dict[int, _Rows] = {}
        """By the length of the embeddings."""

    def add(self, image: str, embedding: Embedding, shades: Shades) -> None:
        self._rows.setdefault(len(embedding), _Rows(len(embedding))).add(image, embedding, shades)

    def remove(self, image: str) -> None:
        for rows in self._rows.values():
            if image in rows.images:
                rows.remove(image)

    def distance(self, embedding: Embedding) -> float:
        """The least cosine distance, in [0, 2], to those kept; infinite without any to compare with."""
        return float(self._distances(embedding).min(initial=math.inf))

    def is_duplicate(self, embedding: Embedding, shades: Shades) -> bool:
        """Whether a kept image shows the same."""
        is_near = self._distances(embedding) < DUPLICATE_DISTANCE
        return bool(
            is_near.any() and same_shades(shades, self._rows[len(embedding)].column("shades")[is_near]).any()
        )

    def _distances(self, embedding: Embedding) -> NDArray[np.float32]:
        direction, rows = unit(embedding), self._rows.get(len(embedding))
        if direction is None or rows is None:
            return np.empty(0, np.float32)
        return np.asarray(np.maximum(1 - rows.column("embedding") @ direction, 0), np.float32)


class _Rows:
    """An array that grows; the last row takes the place of one that is removed."""

    def __init__(self, length: int) -> None:
        columns = [("embedding", np.float32, (length,)), ("shades", np.int8, (SHADES,))]
        self._array: NDArray[np.void] = np.empty(MIN_ROWS, np.dtype(columns))
        self.images: list[str] = []

    def column(self, name: str) -> NDArray[Any]:
        return np.asarray(self._array[name][: len(self.images)])

    def add(self, image: str, embedding: Embedding, shades: Shades) -> None:
        if len(self.images) == len(self._array):
            self._array = np.concatenate([self._array, np.empty_like(self._array)])
        self._array[len(self.images)] = embedding, shades
        self.images.append(image)

    def remove(self, image: str) -> None:
        row, last = self.images.index(image), len(self.images) - 1
        self._array[row], self.images[row] = self._array[last], self.images[last]
        self.images.pop()


class UsualDescriptor:
    """The mean of the embeddings of a camera's images by one model, and how far from it they usually are."""

    def __init__(self) -> None:
        self._model = ""
        self._count = 0
        self._mean: Embedding = np.zeros(0, np.float32)
        self._usual_distance = 0.0

    def times_usual(self, embedding: Embedding, model: str) -> float:
        """The cosine distance of `embedding` of `model` from the mean, divided by the usual one.

        0 for one without direction, and until MIN_IMAGES are known. The embedding counts in the mean from
        now on; another model starts afresh.
        """
        direction = unit(embedding)
        if direction is None:
            return 0.0
        if model != self._model or len(embedding) != len(self._mean):
            self._model, self._count, self._usual_distance = model, 0, 0.0
            self._mean = np.zeros_like(embedding)
        self._count = min(self._count + 1, _USUAL_IMAGES)
        self._mean += (direction - self._mean) / np.float32(self._count)
        distance = max(1 - float(direction @ self._mean) / float(np.linalg.norm(self._mean)), 0.0)
        self._usual_distance += (distance - self._usual_distance) / self._count
        is_known = self._count >= MIN_IMAGES and self._usual_distance > 0
        return distance / self._usual_distance if is_known else 0.0
