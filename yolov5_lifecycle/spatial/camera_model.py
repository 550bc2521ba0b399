"""Cameras as sensor_msgs/CameraInfo describes them: which ray each pixel sees."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from types import MappingProxyType
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.images.image import MAX_SIDE_PX, ImageError, check_frame_id

MIN_FOCAL_PX = 0.1
MAX_PX = 1e7
"""Beyond these there is no camera, and coordinates in space would not be finite."""

COEFFICIENTS: Mapping[str, tuple[int, ...]] = MappingProxyType(
    {"plumb_bob": (4, 5), "rational_polynomial": (8, 12, 14), "equidistant": (4,)}
)
"""Models of distortion by their names in sensor_msgs/distortion_models.hpp: how many numbers D has."""

_CELLS = 64
"""Along each side of a distorted image; rays are computed at their corners, and interpolated between."""
_STEPS = 10
"""Of Newton's method, which needs four for every usual lens."""
_MAX_ERROR_PX = 0.05
"""Of a ray that was found, in the image. Where a lens model folds over, there is none."""
_MAX_TANGENT = 20.0
"""Of 87 degrees from the axis. Depth along the axis says little of what is farther to the side."""
_MIN_SEEN = 0.25
"""Share of the image that must have rays."""

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Distortion:
    """What a lens does to an image that nobody has rectified: a model of COEFFICIENTS and its numbers, D.

    Raises ImageError on construction for another model, or other numbers than it has.
    """

    model: str
    coefficients: tuple[float, ...]

    def __post_init__(self) -> None:
        counts = COEFFICIENTS.get(self.model)
        remedy = "Subscribe to rectified images (image_proc), or calibrate the camera again"
        if counts is None:
            known = ", ".join(COEFFICIENTS)
            raise ImageError(f"Expected a distortion_model of {known}, found {self.model[:40]!r}. {remedy}.")
        if len(self.coefficients) not in counts or not np.isfinite(self.coefficients).all():
            raise ImageError(
                f"Expected {' or '.join(map(str, counts))} numbers D of {self.model}, found "
                f"{len(self.coefficients)}: {str(self.coefficients[:14])[:80]}. {remedy}."
            )


@dataclass(frozen=True)
class Intrinsics:
    """A camera: focal lengths and principal point in pixels of an image of `size_hw`, and its distortion.

    The principal point counts from the centre of the first pixel, as in sensor_msgs/CameraInfo. Raises
    ImageError on construction unless focal lengths are in [0.1, 1e7], the principal point in
    [-1e7, 1e7], the sides in [1, 16384], and a quarter of a distorted image has rays.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    size_hw: tuple[int, int]
    distortion: Distortion | None = None
    """None for a rectified image."""

    def __post_init__(self) -> None:
        are_focal_lengths = all(MIN_FOCAL_PX <= value <= MAX_PX for value in (self.fx, self.fy))
        if not (are_focal_lengths and all(abs(value) <= MAX_PX for value in (self.cx, self.cy))):
            raise ImageError(
                f"Expected intrinsics with fx and fy of {MIN_FOCAL_PX:g} to {MAX_PX:g} pixels and cx and cy "
                f"of at most {MAX_PX:g}, found fx {self.fx:g}, fy {self.fy:g}, cx {self.cx:g}, cy {self.cy:g}"
                ". Calibrate the camera, or have its driver publish the intrinsics of the depth image."
            )
        if not all(1 <= side <= MAX_SIDE_PX for side in self.size_hw):
            height, width = self.size_hw
            raise ImageError(
                f"Expected a camera_info with height and width of 1 to {MAX_SIDE_PX} pixels, found "
                f"{height} x {width}. Have the driver fill in the size of the depth image."
            )
        if self.distortion and (seen := np.isfinite(_grid_of(self)).all(axis=0).mean()) < _MIN_SEEN:
            raise ImageError(
                f"Expected a distortion for at least {_MIN_SEEN:.0%} of the image, found one for {seen:.0%}: "
                f"{str(self.distortion)[:200]}. Calibrate the camera again."
            )

    def tangents(self, columns: Array, rows: Array) -> tuple[Array, Array]:
        """x / z and y / z of the rays through points of the image, in the optical frame.

        `columns` and `rows` can be broadcast against each other, and so can the results. They count from the
        outer corner of the first pixel, as corners of boxes do. NaN where the lens sees nothing.
        """
        if self.distortion is None:
            return (columns - (self.cx + 0.5)) / self.fx, (rows - (self.cy + 0.5)) / self.fy
        height, width = self.size_hw
        down, right = (np.clip(places, 0, 1) * _CELLS for places in (rows / height, columns / width))
        row, column = (np.minimum(places.astype(np.intp), _CELLS - 1) for places in (down, right))
        grid, down, right = _grid_of(self), down - row, right - column
        above = grid[:, row, column] * (1 - right) + grid[:, row, column + 1] * right
        below = grid[:, row + 1, column] * (1 - right) + grid[:, row + 1, column + 1] * right
        x, y = above * (1 - down) + below * down
        return x, y


def intrinsics_of_message(camera_info: Any, *, is_rectified: bool) -> Intrinsics:
    """The intrinsics in a sensor_msgs/CameraInfo, deserialised by any library.

    P is the camera of the rectified image, K and D that of one that is not; where P or K is not filled in,
    the other counts. Raises ImageError as `Intrinsics` and `Distortion`, for matrices of another size, and
    for a frame_id longer than MAX_FRAME_ID.
    """
    check_frame_id(camera_info)
    k, p, d = camera_info.k, camera_info.p, tuple(map(float, camera_info.d))
    if len(k) != 9 or len(p) != 12:
        raise ImageError(
            f"Expected a camera_info with K of 9 and P of 12 values, found {len(k)} and {len(p)}."
        )
    size_hw = camera_info.height, camera_info.width
    model = camera_info.distortion_model
    if not is_rectified and (any(d) or model == "equidistant"):
        distortion = Distortion(model, d)
        return Intrinsics(float(k[0]), float(k[4]), float(k[2]), float(k[5]), size_hw, distortion)
    has_p = p[0] and (is_rectified or not k[0])
    fx, cx, fy, cy = (p[0], p[2], p[5], p[6]) if has_p else (k[0], k[2], k[4], k[5])
    return Intrinsics(float(fx), float(fy), float(cx), float(cy), size_hw)


@lru_cache(maxsize=32)  # a driver sends the same camera_info with every image
def _grid_of(camera: Intrinsics) -> Array:
    """Tangents (2, _CELLS + 1, _CELLS + 1) at the corners of the cells of a distorted image."""
    assert camera.distortion is not None
    height, width = camera.size_hw
    columns, rows = np.meshgrid(np.linspace(0, width, _CELLS + 1), np.linspace(0, height, _CELLS + 1))
    points_xy = np.stack((columns, rows), axis=-1).reshape(-1, 2) - 0.5
    matrix = np.array(((camera.fx, 0, camera.cx), (0, camera.fy, camera.cy), (0, 0, 1)), np.float64)
    coefficients = np.array(camera.distortion.coefficients, np.float64)
    undistorted = _undistorted_fisheye if camera.distortion.model == "equidistant" else _undistorted
    with np.errstate(all="ignore"):  # beyond what a lens model covers
        tangents = undistorted(points_xy, matrix, coefficients)
    grid = tangents.T.reshape(2, _CELLS + 1, _CELLS + 1)
    grid.flags.writeable = False
    return grid


def _undistorted(points_xy: Array, matrix: Array, coefficients: Array) -> Array:
    """Tangents (n, 2) of points (n, 2), from the centre of the first pixel, by Newton's method.

    OpenCV's undistortPoints takes five steps of a slower method, and does not say where they do not suffice.
    """
    nowhere = np.zeros(3)

    def missing(tangents: Array) -> tuple[Array, Array]:
        """From where rays (n, 2) are seen to the points (2, n), and by what that place moves with a ray."""
        rays = np.concatenate((tangents, np.ones((len(tangents), 1))), axis=1)
        found, derivatives = cv2.projectPoints(rays, nowhere, nowhere, matrix, coefficients)
        return (points_xy - found[:, 0]).T, derivatives[:, 3:5].reshape(-1, 2, 2).transpose(1, 2, 0)

    tangents = (points_xy - matrix[:2, 2]) / matrix[(0, 1), (0, 1)]
    for _ in range(_STEPS):
        (right, down), ((xx, xy), (yx, yy)) = missing(tangents)
        steps = np.stack((yy * right - xy * down, xx * down - yx * right))
        tangents = tangents + (steps / (xx * yy - xy * yx)).T
    errors_px, ((xx, xy), (yx, yy)) = missing(tangents)
    is_before_fold = (xx * yy > xy * yx) & (xx + yy > 0)  # beyond it, an image is mirrored or turned round
    is_found = (abs(errors_px).max(axis=0) < _MAX_ERROR_PX) & is_before_fold
    return np.where(is_found[:, None], tangents, np.nan)


def _undistorted_fisheye(points_xy: Array, matrix: Array, coefficients: Array) -> Array:
    """The same for a lens that may see up to 180 degrees."""
    tangents = cv2.fisheye.undistortPoints(points_xy[:, None], matrix, coefficients)
    found = cv2.fisheye.distortPoints(tangents, matrix, coefficients)
    is_found = (abs(found[:, 0] - points_xy) < _MAX_ERROR_PX) & (abs(tangents[:, 0]) < _MAX_TANGENT)
    return np.where(is_found.all(axis=1, keepdims=True), tangents[:, 0], np.nan)
