"""The scene in space, as a depth camera measures it: tilted boards in front of a sloped wall."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.sources.camera_info import CameraInfoValues
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


@dataclass(frozen=True, eq=False)
class _Plane:
    """A plane, `depth_m` away at `ray_xy`; beside it 1 / z falls by `slopes_xy`, as a share, per unit."""

    depth_m: float
    ray_xy: NDArray[np.float64]
    slopes_xy: NDArray[np.float64]

    def depths_m(self, rays_xy: NDArray[np.float64]) -> NDArray[np.float64]:
        """Depth (...) at rays (..., 2): x and y at z = 1."""
        return np.asarray(self.depth_m / (1 - (rays_xy - self.ray_xy) @ self.slopes_xy), np.float64)

    def depths_mm(self, rays_xy: NDArray[np.float64]) -> NDArray[np.uint16]:
        """The same in whole millimetres."""
        return np.asarray(np.rint(1000 * self.depths_m(rays_xy)), np.uint16)


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
        self._focal_px, _, cx, _, _, cy = self._camera_info.camera_matrix.data[:6]
        self._centre_xy = np.array([cx, cy])
        radii_px = [shape.radius for shape in scene.shapes(0)]
        distances_m = rng.permutation(np.geomspace(*_DISTANCES_M, len(radii_px)))
        self._radii_m = distances_m * radii_px / self._focal_px
        self._slopes_xy = rng.uniform(-_MAX_SLOPE, _MAX_SLOPE, (len(radii_px), 2))
        wall = _Plane(_WALL_M, np.zeros(2), rng.uniform(-_MAX_SLOPE, _MAX_SLOPE, 2))
        rows, columns = np.indices(scene.size_hw)
        self._rays_xy = self._rays_of(np.stack((columns, rows), axis=-1).astype(np.float64))
        self._wall_mm = wall.depths_mm(self._rays_xy)

    def frame(self, index: int) -> DepthFrame:
        """Depth and ground truth of image number `index`, owned by the caller."""
        depth_mm = self._wall_mm.copy()
        corners_m = []
        shapes = self._scene.shapes(index)
        for shape, radius_m, slopes_xy in zip(shapes, self._radii_m, self._slopes_xy, strict=True):
            distance_m = self._focal_px * radius_m / shape.radius
            board = _Plane(distance_m, self._rays_of(np.array(shape.centre_xy) - 0.5), slopes_xy)
            self._add(depth_mm, board, shape)
            rays_xy = self._rays_of(shape.outline() - 0.5)  # outlines count from pixel corners
            surface = (
                np.append(rays_xy, np.ones((len(rays_xy), 1)), axis=1) * board.depths_m(rays_xy)[:, None]
            )
            corners_m.append((surface.min(axis=0), surface.max(axis=0)))
        low, high = np.array(corners_m).swapaxes(0, 1)
        return DepthFrame(depth_mm, (low + high) / 2, high - low, self._camera_info)

    def _rays_of(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """x and y at z = 1 of points (..., 2) in pixels; (0, 0) is the centre of the first pixel."""
        return np.asarray((points - self._centre_xy) / self._focal_px, np.float64)

    def _add(self, depth_mm: NDArray[np.uint16], board: _Plane, shape: Shape) -> None:
        """Measure the board instead of what is behind it, where it covers more than half of a pixel."""
        (x, y), reach = shape.centre_xy, shape.radius + 2
        left, top = max(int(x - reach), 0), max(int(y - reach), 0)
        part = np.s_[top : int(y + reach) + 1, left : int(x + reach) + 1]
        behind_mm = depth_mm[part]
        cover = np.zeros((*behind_mm.shape, 3), np.uint8)
        replace(shape, centre_xy=(x - left, y - top), colour=(255, 255, 255)).draw(cover)
        measured_mm = board.depths_mm(self._rays_xy[part])
        np.minimum(behind_mm, measured_mm, out=behind_mm, where=cover[..., 0] > 127)


def scene_camera_info(size_hw: tuple[int, int]) -> CameraInfoValues:
    """A camera without distortion that sees 53 degrees along the longer side of its image."""
    height, width = size_hw
    focal_px = float(max(size_hw))
    cx, cy = (width - 1) / 2, (height - 1) / 2
    return CameraInfoValues.model_validate(
        {
            "image_width": width,
            "image_height": height,
            "distortion_model": "plumb_bob",
            "distortion_coefficients": {"data": (0, 0, 0, 0, 0)},
            "camera_matrix": {"data": (focal_px, 0, cx, 0, focal_px, cy, 0, 0, 1)},
            "rectification_matrix": {"data": (1, 0, 0, 0, 1, 0, 0, 0, 1)},
            "projection_matrix": {"data": (focal_px, 0, cx, 0, 0, focal_px, cy, 0, 0, 0, 1, 0)},
        }
    )
