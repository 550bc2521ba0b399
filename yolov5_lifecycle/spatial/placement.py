"""Surfaces of objects in a depth image -> boxes in space."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.spatial.box_samples import SIDE
from yolov5_lifecycle.spatial.camera_model import Intrinsics
from yolov5_lifecycle.spatial.depth_image import DepthImage
from yolov5_lifecycle.spatial.surface import Surfaces

_EDGES = np.arange(SIDE + 1) / SIDE
"""Of the samples along each side of a box, in parts of it."""


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
    OTHER_CAMERA = "other camera"
    NO_VALID_DEPTH = "no valid depth in box"


Placement = Box3D | Unplaced


def unusable(
    image_size_hw: tuple[int, int], depth: DepthImage, intrinsics: Intrinsics | None
) -> Unplaced | None:
    """Why no box of an image can be placed, None if boxes can be."""
    if intrinsics is None:
        return Unplaced.NO_CAMERA_INFO
    return None if image_size_hw == depth.size_hw == intrinsics.size_hw else Unplaced.OTHER_SIZE


def place(found: Surfaces, camera: Intrinsics) -> tuple[Placement, ...]:
    """Where the objects are whose surfaces were found in an image of the camera, one entry per box.

    docs/depth.md describes how the distance is found.
    """
    boxes_xyxy, surfaces = found.boxes_xyxy.astype(np.float64), found.metres
    start, end = boxes_xyxy[:, None, :2], boxes_xyxy[:, None, 2:]
    columns, rows = np.moveaxis(start + _EDGES[:, None] * (end - start), -1, 0)
    tangents = camera.tangents(columns[:, None, :], rows[:, :, None])
    x, y = np.broadcast_arrays(*tangents)  # (n, SIDE + 1, SIDE + 1)
    across, down = (x[:, :-1] + x[:, 1:]) / 2, (y[..., :-1] + y[..., 1:]) / 2
    extents = (
        _extent(across, surfaces),
        _extent(down.transpose(0, 2, 1), surfaces.transpose(0, 2, 1)),
        (np.fmin.reduce(surfaces, axis=(1, 2)), np.fmax.reduce(surfaces, axis=(1, 2))),
    )
    lower, upper = np.array(extents).transpose(1, 2, 0)
    centres, sizes = (lower + upper) / 2, upper - lower
    return tuple(
        Box3D(tuple(centre), tuple(size)) if all(map(math.isfinite, size)) else Unplaced.NO_VALID_DEPTH
        for centre, size in zip(centres.tolist(), sizes.tolist(), strict=True)
    )


def _extent(
    edges: NDArray[np.float64], surfaces: NDArray[np.float32]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """From where to where in metres (n,) surfaces (n, SIDE, SIDE) extend along their last axis.

    `edges` (n, SIDE, SIDE + 1) are tangents of the edges of the samples along that axis. The outermost
    samples reach to the sides of the box, as the object does, seen or hidden. NaN where nothing is seen.
    """
    is_seen = np.asarray(np.isfinite(surfaces).any(axis=1))
    places = np.arange(SIDE)
    first, last = is_seen.argmax(axis=1), SIDE - 1 - is_seen[:, ::-1].argmax(axis=1)
    is_first, is_last = (places <= first[:, None])[:, None], (places >= last[:, None])[:, None]
    lower = np.where(is_first, edges[..., :1], edges[..., :-1]) * surfaces
    upper = np.where(is_last, edges[..., -1:], edges[..., 1:]) * surfaces
    return np.fmin.reduce(lower, axis=(1, 2)), np.fmax.reduce(upper, axis=(1, 2))
