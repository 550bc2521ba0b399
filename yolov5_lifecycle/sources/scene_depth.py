"""The scene in space, as a depth camera measures it: tilted boards in front of a sloped wall."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.sources.camera_info import CameraInfoValues, Matrix
from yolov5_lifecycle.sources.scene import Scene, Shape

_DISTANCES_M = (1.25, 3.2)
"""Distances in the first image; later the shapes come up to a fifth nearer or go up to a quarter farther."""
_WALL_M = 7.0
_MAX_SLOPE = 0.5
_RANDOM_STREAM = 1
"""Combined with the seed, so that the image of a seed does not depend on depth."""


@dataclass(frozen=True, eq=False)
class DepthFrame:
    """What a depth camera in the place of the colour camera measures, and where the shapes are.

    x points right, y down and z forward, in metres from the camera; one row per shape, in the order of the
    ground truth of the image. The boxes have axes parallel to these.
    """

    depth_mm: NDArray[np.uint16]
    """(H, W) distances along z in millimetres."""
    centres_xyz_m: NDArray[np.float64]
    """(n, 3) centres of the boxes around the shapes."""
    sizes_xyz_m: NDArray[np.float64]
    """(n, 3) sizes of these boxes."""
    camera_info: CameraInfoValues
    """The same for both cameras."""


class SceneDepth:
    """The shapes of a `Scene` as flat boards, each with its own size, tilt and distance.

    A shape that grows in the image comes nearer. Where two shapes overlap, the nearer one is measured; all
    are in front of the wall.

    Deterministic, like the scene itself.
    """

    def __init__(self, seed: int, scene: Scene) -> None:
        rng = np.random.default_rng([seed, _RANDOM_STREAM])
        self._scene = scene
        self._camera_info = scene_camera_info(scene.size_hw)
        first = scene.shapes(0)
        distances_m = rng.permutation(np.geomspace(*_DISTANCES_M, len(first)))
        self._radii_m = [
            distance_m * shape.radius / self._focal_px
            for distance_m, shape in zip(distances_m.tolist(), first, strict=True)
        ]
        self._slopes_xy = rng.uniform(-_MAX_SLOPE, _MAX_SLOPE, (len(first), 2))
        height, width = scene.size_hw
        wall = _Plane(_WALL_M, np.zeros(2), rng.uniform(-_MAX_SLOPE, _MAX_SLOPE, 2))
        self._wall_mm = self._measured(wall, slice(0, height), slice(0, width))

    def frame(self, index: int) -> DepthFrame:
        """Depth and ground truth of image number `index`, owned by the caller."""
        depth_mm = self._wall_mm.copy()
        corners_m = []
        for number, shape in enumerate(self._scene.shapes(index)):
            board = self._board(number, shape)
            self._add(depth_mm, board, shape)
            rays = self._rays(shape.outline() - 0.5)  # outlines count from pixel corners
            surface = np.append(rays, np.ones((len(rays), 1)), axis=1) * board.depths_m(rays)[:, None]
            corners_m.append((surface.min(axis=0), surface.max(axis=0)))
        low, high = np.array(corners_m).swapaxes(0, 1)
        return DepthFrame(depth_mm, (low + high) / 2, high - low, self._camera_info)

    @property
    def _focal_px(self) -> float:
        return self._camera_info.camera_matrix.data[0]

    def _board(self, number: int, shape: Shape) -> _Plane:
        distance_m = self._focal_px * self._radii_m[number] / shape.radius
        return _Plane(distance_m, self._rays(np.array(shape.centre_xy) - 0.5), self._slopes_xy[number])

    def _rays(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """x and y at z = 1 of points (..., 2) in pixels; (0, 0) is the centre of the first pixel."""
        centre = np.array([self._camera_info.camera_matrix.data[2], self._camera_info.camera_matrix.data[5]])
        return np.asarray((points - centre) / self._focal_px, np.float64)

    def _measured(self, plane: _Plane, rows: slice, columns: slice) -> NDArray[np.uint16]:
        y, x = np.mgrid[rows, columns]
        rays = self._rays(np.stack((x, y), axis=-1).astype(np.float64))
        return np.asarray(np.rint(1000 * plane.depths_m(rays)), np.uint16)

    def _add(self, depth_mm: NDArray[np.uint16], board: _Plane, shape: Shape) -> None:
        """Measure the board instead of what is behind it, where it covers more than half of a pixel."""
        height, width = depth_mm.shape
        (left, top), reach = np.array(shape.centre_xy) - shape.radius, math.ceil(2 * shape.radius) + 2
        rows = slice(max(int(top) - 1, 0), min(int(top) + reach, height))
        columns = slice(max(int(left) - 1, 0), min(int(left) + reach, width))
        behind_mm = depth_mm[rows, columns]
        covered = _covered(shape, (columns.start, rows.start), behind_mm.shape)
        measured_mm = self._measured(board, rows, columns)
        np.minimum(behind_mm, measured_mm, out=behind_mm, where=covered)


@dataclass(frozen=True, eq=False)
class _Plane:
    """A plane, `depth_m` away at `ray_xy`; beside it 1 / z falls by `slopes_xy`, as a share, per unit."""

    depth_m: float
    ray_xy: NDArray[np.float64]
    slopes_xy: NDArray[np.float64]

    def depths_m(self, rays_xy: NDArray[np.float64]) -> NDArray[np.float64]:
        """Depth (...) at rays (..., 2)."""
        return np.asarray(self.depth_m / (1 - (rays_xy - self.ray_xy) @ self.slopes_xy), np.float64)


def scene_camera_info(size_hw: tuple[int, int]) -> CameraInfoValues:
    """A camera without distortion that sees 53 degrees along the longer side of its image."""
    height, width = size_hw
    focal_px = float(max(size_hw))
    cx, cy = (width - 1) / 2, (height - 1) / 2
    return CameraInfoValues(
        image_width=width,
        image_height=height,
        camera_name="scene",
        distortion_model="plumb_bob",
        distortion_coefficients=Matrix(rows=1, cols=5, data=(0.0,) * 5),
        camera_matrix=Matrix(rows=3, cols=3, data=(focal_px, 0, cx, 0, focal_px, cy, 0, 0, 1)),
        rectification_matrix=Matrix(rows=3, cols=3, data=(1, 0, 0, 0, 1, 0, 0, 0, 1)),
        projection_matrix=Matrix(rows=3, cols=4, data=(focal_px, 0, cx, 0, 0, focal_px, cy, 0, 0, 0, 1, 0)),
    )


def _covered(shape: Shape, origin_xy: tuple[int, int], size_hw: tuple[int, ...]) -> NDArray[np.bool_]:
    """The pixels of a part of the image (h, w), from `origin_xy` on, of which `shape` covers over a half."""
    x, y = shape.centre_xy
    pixels = np.zeros((*size_hw, 3), np.uint8)
    white = (255, 255, 255)
    replace(shape, centre_xy=(x - origin_xy[0], y - origin_xy[1]), colour=white).draw(pixels)
    return pixels[..., 0] > 127
