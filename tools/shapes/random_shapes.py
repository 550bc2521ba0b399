"""Images of random shapes whose content is known, with which the embedded model is trained and tested."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.sources.scene import (
    CLASS_NAMES,
    Scene,
    Shape,
    Truth,
    check_size,
    cluttered_background,
    contrasting_colour,
    label_image,
    truth_of,
)


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


def random_scene(rng: np.random.Generator, size_hw: tuple[int, int]) -> tuple[NDArray[np.uint8], Truth]:
    """A still RGB image (H, W, 3) of `random_shapes`, and its ground truth."""
    pixels, shapes = random_shapes(rng, size_hw)
    return pixels, truth_of(shapes, size_hw)


def random_shapes(
    rng: np.random.Generator, size_hw: tuple[int, int]
) -> tuple[NDArray[np.uint8], list[Shape]]:
    """A still RGB image (H, W, 3) with 0 to 12 random shapes, in the order in which they were drawn.

    Shapes measure 0.09 to 0.62 of the shorter side, overlap slightly at most and lie mostly inside the
    image. Raises ValueError when `size_hw` has a side below SMALLEST_SIDE_PX.
    """
    check_size(size_hw)
    pixels = cluttered_background(rng, size_hw)
    shapes: list[Shape] = []
    for _ in range(rng.integers(0, 13)):
        shape = _random_shape(rng, pixels)
        if all(_are_apart(shape, other) for other in shapes):
            shape.draw(pixels)
            shapes.append(shape)
    return pixels, shapes


def _random_shape(rng: np.random.Generator, pixels: NDArray[np.uint8]) -> Shape:
    """A shape with at most a seventh of its diameter outside each side, in a contrasting colour."""
    height, width = pixels.shape[:2]
    radius = min(height, width) * math.exp(rng.uniform(math.log(0.045), math.log(0.31)))
    x, y = rng.uniform(0.72 * radius, np.array((width, height)) - 0.72 * radius).tolist()
    left, top = int(max(x - radius, 0)), int(max(y - radius, 0))
    behind = pixels[top : int(y + radius) + 1, left : int(x + radius) + 1]
    return Shape(
        class_id=int(rng.integers(0, len(CLASS_NAMES))),
        centre_xy=(x, y),
        radius=radius,
        angle=rng.uniform(0, 2 * math.pi),
        colour=contrasting_colour(rng, behind),
    )


def _are_apart(shape: Shape, other: Shape) -> bool:
    return math.dist(shape.centre_xy, other.centre_xy) > 0.9 * (shape.radius + other.radius)
