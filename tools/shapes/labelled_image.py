"""Images with known content."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tools.shapes.random_shapes import random_shapes
from yolov5_lifecycle.sources.scene import Scene, Shape, Truth, label_image, truth_of


@dataclass(frozen=True, eq=False)
class LabelledImage:
    """An image and its ground truth."""

    pixels: NDArray[np.uint8]
    """(H, W, 3), RGB."""
    truth: Truth
    labels: NDArray[np.uint16]
    """(H, W), with i + 1 for the pixels of the i-th shape, see `label_image`."""


def still(rng: np.random.Generator, size_hw: tuple[int, int]) -> LabelledImage:
    """A random scene."""
    pixels, shapes = random_shapes(rng, size_hw)
    return LabelledImage(pixels, truth_of(shapes, size_hw), labels_of(shapes, size_hw))


def frame(scene: Scene, index: int) -> LabelledImage:
    """Image number `index` of a moving scene."""
    pixels, truth = scene.frame(index)
    return LabelledImage(pixels, truth, labels_of(scene.shapes(index), scene.size_hw))


def labels_of(shapes: Sequence[Shape], size_hw: tuple[int, int]) -> NDArray[np.uint16]:
    """The label image (H, W) of `shapes`."""
    return label_image([shape.outline() for shape in shapes], size_hw)
