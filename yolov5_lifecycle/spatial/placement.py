"""Boxes in an image and a depth image -> boxes in space."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.spatial.depth_image import DepthImage
from yolov5_lifecycle.spatial.intrinsics import Intrinsics
from yolov5_lifecycle.spatial.surface import sampled, surface_extents_m

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
    image_size_hw: tuple[int, int], depth: DepthImage | None, intrinsics: Intrinsics | None
) -> Unplaced | None:
    """Why no box of an image can be placed, None if boxes can be."""
    if depth is None:
        return Unplaced.NO_DEPTH_IMAGE
    if intrinsics is None:
        return Unplaced.NO_CAMERA_INFO
    return None if image_size_hw == depth.size_hw == intrinsics.size_hw else Unplaced.OTHER_SIZE


def place(
    boxes_xyxy: NDArray[np.float32],
    image_size_hw: tuple[int, int],
    depth: DepthImage | None,
    intrinsics: Intrinsics | None,
) -> tuple[Placement, ...]:
    """Where the objects in the boxes (n, 4) are, one entry per box.

    `boxes_xyxy` are finite corners in pixels of the colour image of `image_size_hw`, to which the depth
    image is aligned; (0, 0) is the outer corner of its first pixel. `depth` and `intrinsics` are None while
    there are none. docs/depth.md describes how the distance is found.
    """
    if (reason := unusable(image_size_hw, depth, intrinsics)) is not None:
        return (reason,) * len(boxes_xyxy)
    assert depth is not None
    assert intrinsics is not None
    placements: list[Placement] = []
    for first in range(0, len(boxes_xyxy), MAX_BOXES_AT_ONCE):
        boxes = boxes_xyxy[first : first + MAX_BOXES_AT_ONCE]
        extents_m = surface_extents_m(sampled(depth, boxes))
        placements += _placements(boxes.astype(np.float64), extents_m, intrinsics)
    return tuple(placements)


def _placements(
    boxes_xyxy: NDArray[np.float64], extents_m: NDArray[np.float64], camera: Intrinsics
) -> list[Placement]:
    """One entry per box (n, 4) whose surface extends from near to far, (n, 2); NaN without a surface."""
    near_m, far_m = extents_m.T
    depth_m = (near_m + far_m) / 2
    # Boxes count from the corner of the first pixel, intrinsics from its centre.
    left, top, right, bottom = (
        (boxes_xyxy - 0.5 - [camera.cx, camera.cy] * 2) / ([camera.fx, camera.fy] * 2)
    ).T
    centres = (
        np.stack(((left + right) / 2, (top + bottom) / 2, np.ones_like(depth_m)), axis=1) * depth_m[:, None]
    )
    sizes = np.stack(((right - left) * depth_m, (bottom - top) * depth_m, far_m - near_m), axis=1)
    return [
        Box3D(tuple(centre), tuple(size)) if math.isfinite(centre[2]) else Unplaced.NO_VALID_DEPTH
        for centre, size in zip(centres.tolist(), sizes.tolist(), strict=True)
    ]
