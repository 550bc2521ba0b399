"""Boxes in an image and a depth image -> boxes in space."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.spatial.box_samples import SIDE
from yolov5_lifecycle.spatial.depth_image import DepthImage, Intrinsics
from yolov5_lifecycle.spatial.surface import surfaces_m

MAX_BOXES_AT_ONCE = 64
"""More boxes are placed in several passes, so that the arrays stay small."""


@dataclass(frozen=True)
class Box3D:
    """The bounding box of an object's visible surface, axes parallel to those of the optical frame.

    x points right, y down and z forward, in metres from the camera.
    """

    centre_xyz_m: tuple[float, float, float]
    size_xyz_m: tuple[float, float, float]

    @property
    def distance_m(self) -> float:
        """From the camera to the centre."""
        return math.hypot(*self.centre_xyz_m)


class Unplaced(Enum):
    """Why a detection has no box in space."""

    NO_DEPTH_IMAGE = "no depth image"
    NO_CAMERA_INFO = "no camera_info"
    OTHER_SIZE = "other size"
    NO_VALID_DEPTH = "no valid depth in box"


Placement = Box3D | Unplaced


def unusable(
    image_size_hw: tuple[int, int], depth: DepthImage, intrinsics: Intrinsics | None
) -> Unplaced | None:
    """Why no box of an image can be placed, None if boxes can be."""
    if intrinsics is None:
        return Unplaced.NO_CAMERA_INFO
    return None if image_size_hw == depth.size_hw == intrinsics.size_hw else Unplaced.OTHER_SIZE


def place(
    boxes_xyxy: NDArray[np.float32],
    image_size_hw: tuple[int, int],
    depth: DepthImage,
    intrinsics: Intrinsics | None,
) -> tuple[Placement, ...]:
    """Where the objects in the boxes (n, 4) are, one entry per box.

    `boxes_xyxy` are finite corners in pixels of the colour image of `image_size_hw`, to which the depth
    image is aligned; (0, 0) is the outer corner of its first pixel. `intrinsics` are None while there
    are none. docs/depth.md describes how the distance is found.
    """
    if (reason := unusable(image_size_hw, depth, intrinsics)) is not None:
        return (reason,) * len(boxes_xyxy)
    assert intrinsics is not None
    placements: list[Placement] = []
    for first in range(0, len(boxes_xyxy), MAX_BOXES_AT_ONCE):
        boxes = boxes_xyxy[first : first + MAX_BOXES_AT_ONCE]
        surfaces = surfaces_m(depth, boxes)
        placements += _placements(boxes.astype(np.float64), surfaces, intrinsics)
    return tuple(placements)


def _placements(
    boxes_xyxy: NDArray[np.float64], surfaces: NDArray[np.float32], camera: Intrinsics
) -> list[Placement]:
    """One entry per box (n, 4) with the depth in metres of its surface (n, SIDE, SIDE), NaN beside it."""
    # Boxes count from the corner of the first pixel, intrinsics from its centre.
    sides = (boxes_xyxy - 0.5 - [camera.cx, camera.cy] * 2) / ([camera.fx, camera.fy] * 2)
    is_seen = ~np.isnan(surfaces)
    near = np.where(is_seen, surfaces, np.float32(np.inf))
    far = np.where(is_seen, surfaces, np.float32(-np.inf))
    # Of the columns, then of the rows: (2, n, SIDE)
    nearest = np.stack((near.min(axis=1), near.min(axis=2))).astype(np.float64)
    farthest = np.stack((far.max(axis=1), far.max(axis=2))).astype(np.float64)
    lower, upper = _extents_across(sides.T.reshape(2, 2, -1), nearest, farthest)
    lower = np.stack((*lower, nearest[0].min(axis=1)), axis=1)
    upper = np.stack((*upper, farthest[0].max(axis=1)), axis=1)
    with np.errstate(invalid="ignore"):  # infinity less infinity, where no surface is seen
        centres, sizes = (lower + upper) / 2, upper - lower
    return [
        Box3D(tuple(centre), tuple(size)) if math.isfinite(centre[2]) else Unplaced.NO_VALID_DEPTH
        for centre, size in zip(centres.tolist(), sizes.tolist(), strict=True)
    ]


def _extents_across(
    sides: NDArray[np.float64], nearest: NDArray[np.float64], farthest: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """From where to where in metres surfaces extend to the right, and downwards: (2, n) each.

    `sides` are left and top, then right and bottom sides of the boxes as tangents (2, 2, n), `nearest` and
    `farthest` the extents in metres of each column of samples, and of each row (2, n, SIDE). The outermost
    ones reach to the sides of the box, as the object does, seen or hidden.
    """
    is_seen = nearest <= farthest
    places = np.arange(SIDE)
    first, last = is_seen.argmax(axis=2), SIDE - 1 - is_seen[..., ::-1].argmax(axis=2)
    start, side = sides[0][..., None], (sides[1] - sides[0])[..., None]
    before = start + np.where(places <= first[..., None], 0, places) / SIDE * side
    after = start + np.where(places >= last[..., None], SIDE, places + 1) / SIDE * side
    with np.errstate(invalid="ignore"):  # 0 times infinity, where no surface is seen
        lower = np.minimum(before * nearest, before * farthest)
        upper = np.maximum(after * nearest, after * farthest)
    return (
        np.where(is_seen, lower, np.inf).min(axis=2),
        np.where(is_seen, upper, -np.inf).max(axis=2),
    )
