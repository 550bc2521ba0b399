"""Synthetic images of circles, squares, triangles and stars over clutter, with ground truth."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

Point = tuple[float, float]
Colour = tuple[int, int, int]
"""Of three channels, 0 to 255."""
CLASS_NAMES = ("circle", "square", "triangle", "star")

SMALLEST_SIDE_PX = 64
_CORNERS = (64, 4, 3, 10)  # of each class's polygon
_STAR_INNER_RADIUS = 0.42  # of the outer one
_SMALLEST_CONTRAST = 110.0  # RGB distance between a shape and the mean of the background behind it
_SUBPIXEL_BITS = 4


@dataclass(frozen=True)
class Truth:
    """Ground truth of an image, one row per shape."""

    boxes_xyxy: NDArray[np.float32]
    """(n, 4) tight bounding boxes in pixels, clipped to the image."""
    class_ids: NDArray[np.int64]
    """(n,) indices into CLASS_NAMES."""


@dataclass(frozen=True)
class Shape:
    """A regular shape: centre and circumscribed radius in pixels, rotation in radians, RGB fill."""

    class_id: int
    centre_xy: Point
    radius: float
    angle: float
    colour: Colour

    def outline(self) -> NDArray[np.float64]:
        """Corners (k, 2) in pixels; (0, 0) is the outer corner of the first pixel."""
        corners = _CORNERS[self.class_id]
        angles = self.angle + np.arange(corners) * (2 * math.pi / corners)
        radii = np.full(corners, self.radius, np.float64)
        if CLASS_NAMES[self.class_id] == "star":
            radii[1::2] *= _STAR_INNER_RADIUS
        corners_xy = np.stack((np.cos(angles), np.sin(angles)), axis=1) * radii[:, None] + self.centre_xy
        return np.asarray(corners_xy, np.float64)

    def draw(self, pixels: NDArray[np.uint8]) -> None:
        """Fill the shape into `pixels` (H, W, 3), in place.

        OpenCV antialiases outwards: about 0.7 pixels beyond the outline, faintly up to 3.
        """
        # OpenCV counts from pixel centres, outlines from pixel corners.
        corners = np.rint((self.outline() - 0.5) * 2**_SUBPIXEL_BITS).astype(np.int32)
        cv2.fillPoly(pixels, [corners], self.colour, cv2.LINE_AA, _SUBPIXEL_BITS)


class Scene:
    """Six drifting, rotating shapes, every class at least once, each in its own cell of a still background.

    They stay in view, and each has the same row of the ground truth in every frame.

    Deterministic: the arguments and the frame index define the position of every shape.
    """

    def __init__(self, seed: int, size_hw: tuple[int, int]) -> None:
        """`seed` >= 0. Raises ValueError when `size_hw` has a side below SMALLEST_SIDE_PX."""
        check_size(size_hw)
        rng = np.random.default_rng(seed)
        self.size_hw = size_hw
        self._background = cluttered_background(rng, size_hw)
        class_ids = rng.permutation([*range(len(CLASS_NAMES)), *rng.integers(0, len(CLASS_NAMES), 2)])
        self._paths = tuple(
            _random_path(rng, self._background, int(class_id), cell_xyxy)
            for class_id, cell_xyxy in zip(class_ids, _six_cells(size_hw), strict=True)
        )

    def frame(self, index: int) -> tuple[NDArray[np.uint8], Truth]:
        """RGB image (H, W, 3) number `index`, owned by the caller, and its ground truth."""
        return self.image(index), truth_of(self.shapes(index), self.size_hw)

    def image(self, index: int) -> NDArray[np.uint8]:
        """RGB image (H, W, 3) number `index`, owned by the caller."""
        pixels = self._background.copy()
        for shape in self.shapes(index):
            shape.draw(pixels)
        return pixels

    def shapes(self, index: int) -> list[Shape]:
        """The shapes in image number `index`, in the order of the ground truth."""
        return [path(index) for path in self._paths]


def cluttered_background(rng: Generator, size_hw: tuple[int, int]) -> NDArray[np.uint8]:
    """An RGB image (H, W, 3) without any of the classes: texture, bars, curves, characters."""
    pixels = _smooth_noise(rng, size_hw)
    things = (_draw_bar, _draw_slim_ellipse, _draw_curve, _draw_letters)
    for _ in range(rng.integers(0, 16)):
        draw = things[rng.integers(0, len(things))]
        x, y = rng.uniform((0, 0), size_hw[::-1]).tolist()
        draw(rng, pixels, (x, y), _random_colour(rng))
    return pixels


def _smooth_noise(rng: Generator, size_hw: tuple[int, int]) -> NDArray[np.uint8]:
    """Low-frequency colour noise with a finer grey texture on top."""
    height, width = size_hw
    colours = rng.uniform(0, 255, (*rng.integers(2, 7, 2), 3))
    variety = rng.uniform(0.1, 1.0)
    coarse = (variety * colours + (1 - variety) * colours[0, 0]).astype(np.float32)
    fine = rng.normal(0, rng.uniform(0, 25), (height // rng.integers(2, 9), width // rng.integers(2, 9), 1))
    pixels = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_LINEAR)
    pixels += cv2.resize(fine.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR)[..., None]
    return np.asarray(np.clip(pixels, 0, 255), np.uint8)


def _draw_bar(rng: Generator, pixels: NDArray[np.uint8], centre_xy: Point, colour: Colour) -> None:
    length = min(pixels.shape[:2]) * rng.uniform(0.1, 0.9)
    size = (length, length * rng.uniform(0.03, 0.22))
    corners = cv2.boxPoints((centre_xy, size, rng.uniform(0, 180)))
    cv2.fillPoly(pixels, [np.int32(corners)], colour, cv2.LINE_AA)


def _draw_slim_ellipse(rng: Generator, pixels: NDArray[np.uint8], centre_xy: Point, colour: Colour) -> None:
    length = min(pixels.shape[:2]) * rng.uniform(0.05, 0.4)
    axes = (int(length), max(int(length * rng.uniform(0.1, 0.35)), 1))
    thickness = -1 if rng.random() < 0.5 else int(rng.integers(1, 4))
    angle = rng.uniform(0, 180)
    point = (int(centre_xy[0]), int(centre_xy[1]))
    cv2.ellipse(pixels, point, axes, angle, 0, 360, colour, thickness, cv2.LINE_AA)


def _draw_curve(rng: Generator, pixels: NDArray[np.uint8], centre_xy: Point, colour: Colour) -> None:
    steps = rng.normal(0, min(pixels.shape[:2]) * 0.12, (rng.integers(2, 9), 2)).cumsum(axis=0)
    cv2.polylines(pixels, [np.int32(centre_xy + steps)], False, colour, int(rng.integers(1, 5)), cv2.LINE_AA)


def _draw_letters(rng: Generator, pixels: NDArray[np.uint8], centre_xy: Point, colour: Colour) -> None:
    text = "".join(rng.choice(list("AEFHIKLMNRTWXYZ147"), rng.integers(1, 6)))
    scale = min(pixels.shape[:2]) * rng.uniform(0.002, 0.012)
    font, thickness = rng.integers(0, 8), rng.integers(1, 5)
    point = (int(centre_xy[0]), int(centre_xy[1]))
    cv2.putText(pixels, text, point, int(font), scale, colour, int(thickness))


def _random_colour(rng: Generator) -> Colour:
    red, green, blue = rng.integers(0, 256, 3).tolist()
    return red, green, blue


def contrasting_colour(rng: Generator, behind: NDArray[np.uint8]) -> Colour:
    """A random colour that contrasts with the mean of the pixels (h, w, 3) `behind`."""
    candidates = rng.integers(0, 256, (16, 3))
    distances = np.linalg.norm(candidates - behind.mean(axis=(0, 1)), axis=1)
    best = int(np.argmax(np.minimum(distances, _SMALLEST_CONTRAST)))  # the first with sufficient distance
    red, green, blue = candidates[best].tolist()
    return red, green, blue


def _six_cells(size_hw: tuple[int, int]) -> list[tuple[int, int, int, int]]:
    """Three by two equal cells (xyxy) of an image, three along its longer side."""
    height, width = size_hw
    columns, rows = (3, 2) if width >= height else (2, 3)
    xs = [width * column // columns for column in range(columns + 1)]
    ys = [height * row // rows for row in range(rows + 1)]
    return [(xs[c], ys[r], xs[c + 1], ys[r + 1]) for r in range(rows) for c in range(columns)]


def _random_path(
    rng: Generator,
    background: NDArray[np.uint8],
    class_id: int,
    cell_xyxy: tuple[int, int, int, int],
) -> Callable[[int], Shape]:
    """A shape by number of the image: sinusoidal in x, y and size within its cell, with constant rotation."""
    left, top, right, bottom = cell_xyxy
    half_x, half_y = (right - left) / 2, (bottom - top) / 2
    largest = min(half_x, half_y) * rng.uniform(0.4, 0.65)
    first_angle = rng.uniform(0, 2 * math.pi)
    colour = contrasting_colour(rng, background[top:bottom, left:right])
    rates = (2 * math.pi / rng.uniform(90, 240, 3)).tolist()  # radians per image, as the turn
    phases = rng.uniform(0, 2 * math.pi, 3).tolist()
    turn = rng.uniform(-0.05, 0.05)

    def shape(index: int) -> Shape:
        x, y, size = (math.sin(rate * index + phase) for rate, phase in zip(rates, phases, strict=True))
        return Shape(
            class_id=class_id,
            centre_xy=(left + half_x + (half_x - largest) * x, top + half_y + (half_y - largest) * y),
            radius=largest * (0.9 + 0.1 * size),
            angle=first_angle + turn * index,
            colour=colour,
        )

    return shape


def truth_of(shapes: Sequence[Shape], size_hw: tuple[int, int]) -> Truth:
    """Ground truth of an image that shows `shapes`."""
    boxes = np.zeros((len(shapes), 4), np.float32)
    for box, shape in zip(boxes, shapes, strict=True):
        corners = np.clip(shape.outline(), 0, size_hw[::-1])
        box[:2], box[2:] = corners.min(axis=0), corners.max(axis=0)
    return Truth(boxes, np.array([shape.class_id for shape in shapes], np.int64))


def label_image(outlines: Sequence[NDArray[np.float64]], size_hw: tuple[int, int]) -> NDArray[np.uint16]:
    """An image (H, W) with 0 for the background and i + 1 for the pixels of the i-th shape.

    `outlines`: the corners (k, 2) of each shape in pixels, as `Shape.outline` gives them. A pixel belongs to
    a shape if its centre is inside the outline, and of several to the last, which is drawn over the others.
    """
    labels = np.zeros(size_hw, np.uint16)
    for label, outline in enumerate(outlines, start=1):
        low = np.clip(np.floor(outline.min(axis=0)).astype(int), 0, size_hw[::-1])
        high = np.clip(np.ceil(outline.max(axis=0)).astype(int), 0, size_hw[::-1])
        part = labels[low[1] : high[1], low[0] : high[0]]
        part[_inside(outline - low, part.shape)] = label
    return labels


def _inside(outline: NDArray[np.float64], size_hw: tuple[int, ...]) -> NDArray[np.bool_]:
    """The pixels (h, w) whose centres have an odd number of crossings with `outline` on their right."""
    centres_y, centres_x = (np.arange(side) + 0.5 for side in size_hw)
    inside = np.zeros(size_hw, np.bool_)
    for (from_x, from_y), (to_x, to_y) in zip(outline, np.roll(outline, -1, axis=0), strict=True):
        rows = (from_y <= centres_y) != (to_y <= centres_y)
        crossings_x = from_x + (centres_y[rows] - from_y) / (to_y - from_y) * (to_x - from_x)
        inside[rows] ^= centres_x < crossings_x[:, None]
    return inside


def check_size(size_hw: tuple[int, int]) -> None:
    """Raises ValueError when `size_hw` has a side below SMALLEST_SIDE_PX."""
    if min(size_hw) < SMALLEST_SIDE_PX:
        raise ValueError(
            f"a scene needs at least {SMALLEST_SIDE_PX} pixels on each side, got {size_hw[0]} rows and "
            f"{size_hw[1]} columns: ask for a larger image"
        )
