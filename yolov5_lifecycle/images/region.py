"""Regions of an image, polygons independent of its size, and which boxes count by regions and sizes."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.printable import in_one_line

PointXY = tuple[float, float]
Anchor = Literal["center", "foot"]

MIN_POINTS = 3
MAX_POINTS = 64
MAX_CHARACTERS = 4096
"""Length limit of the text of a region."""
BORDER = 1e-6
"""A point at most this far from a line lies on it; far less than a pixel, more than float32 rounds."""

_GRID = 10**9
"""Points are compared as multiples of 1 / _GRID: integers, whose products are exact in 64 bits."""
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d{1,3})?", re.ASCII)
_MAX_SHOWN = 40


@dataclass(frozen=True)
class Region:
    """A polygon with MIN_POINTS to MAX_POINTS points, whose lines neither cross nor touch each other.

    Raises ValueError on construction for other points; the message says which ones and why.
    """

    points_xy: tuple[PointXY, ...]
    """In fractions of the image's width and height, in order along the border, which is closed."""

    def __post_init__(self) -> None:
        if not MIN_POINTS <= len(self.points_xy) <= MAX_POINTS:
            raise ValueError(
                f"has {len(self.points_xy)} points, a region has {MIN_POINTS} to {MAX_POINTS}: "
                "'x,y x,y x,y' in fractions of the image"
            )
        _check_each(self.points_xy)
        _check_outline(np.rint(np.array(self.points_xy) * _GRID).astype(np.int64))

    @classmethod
    def parse(cls, text: str) -> Region:
        """The region that `text` describes, such as "0.1,0.5 0.9,0.5 0.5,1"; raises ValueError."""
        if len(text) > MAX_CHARACTERS:
            raise ValueError(f"has {len(text)} characters, more than {MAX_CHARACTERS}")
        return cls(tuple(_parsed(number, word) for number, word in enumerate(text.split(), 1)))

    def contains(self, points_xy: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Which of the points (n, 2), in fractions of the image, lie in the region or on its border."""
        inside, is_on_border = np.zeros((2, len(points_xy)), np.bool_)
        corners = np.array(self.points_xy)
        for corner, line in zip(corners, np.roll(corners, -1, axis=0) - corners, strict=True):
            apart = points_xy - corner
            cross = line[0] * apart[:, 1] - line[1] * apart[:, 0]
            along = (apart * line).sum(axis=1)
            length = np.hypot(*line)
            margin = BORDER * length
            is_on_border |= (np.abs(cross) <= margin) & (along >= -margin) & (along <= length**2 + margin)
            # A ray from the point to the right crosses a line that passes its height with the point left.
            passes = (apart[:, 1] >= 0) != (apart[:, 1] >= line[1])
            inside ^= passes & ((cross > 0) == (line[1] > 0))
        return inside | is_on_border


def _parsed(number: int, word: str) -> PointXY:
    """The point that `word` describes."""
    parts = word.split(",")
    if len(parts) != 2 or not all(map(_NUMBER.fullmatch, parts)):
        shown = in_one_line(word, _MAX_SHOWN)
        raise ValueError(f"has '{shown}' as point {number}: write x,y without a space, as in 0.25,0.5")
    return float(parts[0]), float(parts[1])


def _check_each(points_xy: Sequence[PointXY]) -> None:
    """Raise ValueError unless all points are in the image."""
    for number, (x, y) in enumerate(points_xy, 1):
        if not (0 <= x <= 1 and 0 <= y <= 1):
            raise ValueError(
                f"has point {number} at {x:g},{y:g}, outside the image: coordinates are fractions of its "
                "width and height, from 0 to 1"
            )


def _check_outline(points: NDArray[np.int64]) -> None:
    """Raise ValueError unless the lines between `points` (n, 2), multiples of 1 / _GRID, form a polygon."""
    places = list(map(tuple, points.tolist()))
    for number, place in enumerate(places, 1):
        first = places.index(place) + 1
        if first == 1 and number == len(places):
            raise ValueError("repeats its first point at the end: leave that out, a region closes itself")
        if first != number:
            raise ValueError(f"has point {number} where point {first} is: leave one out")
    sides = _sides(points)
    if not sides.any():
        raise ValueError("has no area: its points lie on one line")
    if (crossing := _first_crossing(points, sides)) is not None:
        one, other = (f"{line + 1}-{(line + 1) % len(points) + 1}" for line in crossing)
        raise ValueError(
            f"has lines that cross or touch, from point to point: {one} and {other}. "
            "Give the points in order along the border"
        )


def _sides(points: NDArray[np.int64]) -> NDArray[np.int64]:
    """(n, n): on which side of line i point j is, -1 or 1, or 0 on the line. Line i begins at point i."""
    lines = np.roll(points, -1, axis=0) - points
    apart = points[None] - points[:, None]
    sides: NDArray[np.int64] = np.sign(lines[:, None, 0] * apart[..., 1] - lines[:, None, 1] * apart[..., 0])
    return sides


def _first_crossing(points: NDArray[np.int64], sides: NDArray[np.int64]) -> tuple[int, int] | None:
    """Indices of the first two lines with a common point, other than the shared end of adjacent lines."""
    ends = np.roll(points, -1, axis=0)
    low, high = np.minimum(points, ends), np.maximum(points, ends)
    is_divided = sides * np.roll(sides, -1, axis=1) <= 0  # whether line i has not all of line j on one side
    is_near = ((low[:, None] <= high[None]) & (low[None] <= high[:, None])).all(axis=2)
    meets = np.triu(is_divided & is_divided.T & is_near, k=1)
    lines = ends - points
    for line in range(len(points)):
        following = (line + 1) % len(points)
        is_turning_back = sides[line, (line + 2) % len(points)] == 0 and lines[line] @ lines[following] < 0
        meets[min(line, following), max(line, following)] = is_turning_back
    pairs = np.argwhere(meets)
    return (int(pairs[0, 0]), int(pairs[0, 1])) if len(pairs) else None


@dataclass(frozen=True, kw_only=True)
class BoxFilter:
    """The settings of the same names; with their defaults every box counts."""

    regions: tuple[Region, ...] = ()
    """A box counts only if its anchor is in one of them; without any, everywhere."""
    ignore_regions: tuple[Region, ...] = ()
    """A box does not count if its anchor is in one of them."""
    region_anchor: Anchor = "center"
    """Which point of a box must be in a region: its centre, or the middle of its lower side."""
    min_box_size: float = 0.0
    """Minimum longer side of a box: up to 1 a fraction of the image's longer side, above 1 pixels."""
    max_box_size: float = 0.0
    """Maximum longer side, in the same units; 0 for none."""

    def admits(self, boxes_xyxy: NDArray[np.float32], size_hw: tuple[int, int]) -> NDArray[np.bool_]:
        """Which of the boxes (n, 4), in pixels of an image of `size_hw`, count."""
        counts = np.ones(len(boxes_xyxy), np.bool_)
        longer_px = (boxes_xyxy[:, 2:] - boxes_xyxy[:, :2]).max(axis=1)
        if self.min_box_size:
            counts &= longer_px >= _pixels(self.min_box_size, size_hw)
        if self.max_box_size:
            counts &= longer_px <= _pixels(self.max_box_size, size_hw)
        boxes = boxes_xyxy.astype(np.float64)
        anchors_xy = (boxes[:, :2] + boxes[:, 2:]) / 2
        if self.region_anchor == "foot":
            anchors_xy[:, 1] = boxes[:, 3]
        anchors_xy /= (size_hw[1], size_hw[0])
        if self.regions:
            counts &= np.any([region.contains(anchors_xy) for region in self.regions], axis=0)
        for region in self.ignore_regions:
            counts &= ~region.contains(anchors_xy)
        return counts


def _pixels(size: float, size_hw: tuple[int, int]) -> np.float32:
    """A size as a number of pixels."""
    return np.float32(size if size > 1 else size * max(size_hw))
