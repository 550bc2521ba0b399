"""Rendered depth images of one object before a sloped background, with ground truth in metres.

The depth image has what sensors add: noise that grows with the square of the depth, pixels between two
surfaces at the edges, and holes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from support.solids import Sphere
from yolov5_lifecycle.detection.masks import Masks
from yolov5_lifecycle.spatial.camera_model import Distortion, Intrinsics

Shape = Literal["board", "disc", "sphere", "pole", "diagonal", "frame"]
SHAPES: tuple[Shape, ...] = ("board", "disc", "sphere", "pole", "diagonal", "frame")
THIN: tuple[Shape, ...] = ("pole", "diagonal", "frame")
"""A few pixels wide, or filling only a tenth to a third of their box."""

CAMERA = Intrinsics(fx=270.0, fy=270.0, cx=159.5, cy=119.5, size_hw=(240, 320))
LENSES = {
    "barrel": replace(CAMERA, distortion=Distortion("plumb_bob", (-0.3, 0.1, 1e-3, -1e-3, -0.01))),
    "wide": replace(
        CAMERA,
        fx=150.0,
        fy=150.0,
        distortion=Distortion("rational_polynomial", (0.5, -2.7, 6e-4, -2e-4, 1.6, 0.38, -2.5, 1.5)),
    ),
    "fisheye": replace(
        CAMERA, fx=150.0, fy=150.0, distortion=Distortion("equidistant", (0.05, -0.01, 0.003, -0.001))
    ),
}
"""Cameras whose images nobody has rectified."""
_NOISE_PER_M = 0.0015  # standard deviation in metres at one metre
REACH_M = 12.0
_BOX_JITTER = 0.04  # of the side of a box, as detectors err


@dataclass(frozen=True)
class Difficulty:
    """What makes a scene hard."""

    hole_share: float = 0.0
    """Of all pixels, half of them alone, half in patches."""
    is_half_occluded: bool = False
    """A nearer board covers half of the object and goes on beyond its box."""
    is_box_of_visible: bool = False
    """The box is always that of the half that is visible; otherwise half of the boxes are of the whole."""
    has_neighbours: bool = False
    """The same surface again on its left and on its right, at the same depth."""
    stands_on_floor: bool = False
    """The background is a floor that begins at the object's lower edge."""


@dataclass(frozen=True, eq=False)
class DepthScene:
    """A depth image, the box of its object and where that object is."""

    depth_m: NDArray[np.float32]
    """(H, W) in metres; holes are 0."""
    box_xyxy: NDArray[np.float32]
    """(4,) corners in pixels, as a detector would give them."""
    centre_xyz_m: NDArray[np.float64]
    """(3,) centre of the bounding box of the object's surface, in the optical frame."""
    size_xyz_m: NDArray[np.float64]
    """(3,) size of that bounding box."""
    mask: NDArray[np.bool_]
    """(H, W), the visible pixels of the object."""
    hidden_share: float = 0.0
    """Of the object's pixels."""
    camera: Intrinsics = CAMERA

    def masks(self, aside_px: int = 0, cell_px: int = 1) -> Masks:
        """The mask of the object, so far too much to the right and down, in cells with sides of `cell_px`."""
        moved = np.roll(self.mask, aside_px, axis=(0, 1))
        return one_mask(
            moved.reshape(-1, cell_px, len(moved[0]) // cell_px, cell_px).mean(axis=(1, 3)), cell_px
        )

    @property
    def range_m(self) -> float:
        return float(np.linalg.norm(self.centre_xyz_m))


def random_depth_scene(
    rng: np.random.Generator, shape: Shape, difficulty: Difficulty = Difficulty()
) -> DepthScene:
    """A scene with an object of `shape`, at least a tenth nearer than the background at its place."""
    background = _sloped_background(rng)
    surface = np.full_like(background, np.inf)
    while np.isfinite(surface).sum() < 40:
        surface = _object_surface(rng, shape, background)
    seen = np.isfinite(surface)
    if difficulty.stands_on_floor:
        background = _floor_below(surface)
    depth_m = np.minimum(background, surface)
    if difficulty.has_neighbours:
        depth_m = np.minimum(depth_m, _beside(rng, surface))
    visible = seen
    if difficulty.is_half_occluded:
        occluder = _occluder(rng, surface)
        depth_m = np.minimum(depth_m, occluder)
        visible = seen & np.isinf(occluder)
        if rng.random() < 0.5 or difficulty.is_box_of_visible:
            seen = visible
    lower, upper = bounds(np.where(seen, surface, np.inf))
    return DepthScene(
        depth_m=measured_by_a_sensor(rng, depth_m, difficulty.hole_share),
        box_xyxy=jittered_box(rng, seen),
        centre_xyz_m=(lower + upper) / 2,
        size_xyz_m=upper - lower,
        mask=visible,
        hidden_share=1 - float(visible.sum() / np.isfinite(surface).sum()),
    )


def one_mask(share: NDArray[np.bool_] | NDArray[np.float64], cell_px: int = 1) -> Masks:
    """A model's masks of one object that fills this share of each cell (h, w)."""
    logits = ((share - 0.5) * 18).astype(np.float32)
    height, width = share.shape
    return Masks(logits[None], np.ones((1, 1), np.float32), (height * cell_px, width * cell_px))


def rays(
    camera: Intrinsics = CAMERA,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """x / z, y / z and 1 of each pixel's centre, (H, W) each; NaN where a lens sees nothing."""
    height, width = camera.size_hw
    x, y = np.broadcast_arrays(*camera.tangents(np.arange(0.5, width), np.arange(0.5, height)[:, None]))
    return x, y, np.ones_like(x)


def pixels(camera: Intrinsics, tangents: NDArray[np.float64]) -> NDArray[np.float64]:
    """Column and row (2, n), from the centre of the first pixel, of rays (2, n), by OpenCV's lens models."""
    matrix = np.array(((camera.fx, 0, camera.cx), (0, camera.fy, camera.cy), (0, 0, 1)), np.float64)
    lens = camera.distortion
    coefficients = np.array(lens.coefficients if lens else (), np.float64)
    if lens and lens.model == "equidistant":
        found = cv2.fisheye.distortPoints(tangents.T[:, None], matrix, coefficients)
    else:
        directions = np.stack((*tangents, np.ones(tangents.shape[1])), axis=1)
        found, _ = cv2.projectPoints(directions, np.zeros(3), np.zeros(3), matrix, coefficients)
    return np.asarray(found[:, 0].T, np.float64)


def _plane(
    depth_m: float, slope_x: float, slope_y: float, centre_xy: tuple[float, float]
) -> NDArray[np.float64]:
    """Depth (H, W) of a plane through (x, y, 1) * depth_m, whose depth grows by slope metres per metre."""
    x, y, _ = rays()
    x0, y0 = centre_xy
    scale = 1 - slope_x * x0 - slope_y * y0
    return depth_m * scale / np.maximum(1 - slope_x * x - slope_y * y, 0.05)


def _sloped_background(rng: np.random.Generator) -> NDArray[np.float64]:
    slope_x, slope_y = rng.uniform(-0.8, 0.8), rng.uniform(-0.8, 0.8)
    return _plane(rng.uniform(2.0, 9.0), slope_x, slope_y, (0.0, 0.0))


def _object_surface(
    rng: np.random.Generator, shape: Shape, background: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Depth (H, W) of an object, infinite beside it."""
    height, width = CAMERA.size_hw
    column, row = rng.integers((30, 30), (width - 30, height - 30)).tolist()
    radius = math.exp(rng.uniform(math.log(8), math.log(80))) / CAMERA.fx
    centre_xy = ((column - CAMERA.cx) / CAMERA.fx, (row - CAMERA.cy) / CAMERA.fy)
    reach = math.ceil(1.5 * radius * CAMERA.fx)
    left, top = max(column - reach, 0), max(row - reach, 0)
    behind_m = float(background[top : row + reach + 1, left : column + reach + 1].min())
    depth_m = min(max(rng.uniform(0.25, 0.85) * behind_m, 0.6), 0.9 * behind_m)
    if shape == "sphere":
        return _sphere(depth_m, radius, centre_xy)
    slope_x, slope_y = rng.uniform(-0.4, 0.4, 2).tolist()
    plane = _plane(depth_m, slope_x, slope_y, centre_xy)
    return np.where(_silhouette(rng, shape, radius, centre_xy), plane, np.inf)


def _silhouette(
    rng: np.random.Generator, shape: Shape, radius: float, centre_xy: tuple[float, float]
) -> NDArray[np.bool_]:
    x, y, _ = rays()
    dx, dy = (x - centre_xy[0]) / radius, (y - centre_xy[1]) / radius
    aspect = rng.uniform(0.4, 1.0)
    if shape == "disc":
        return (dx / aspect) ** 2 + dy**2 < 1
    if shape == "pole":
        return (abs(dx) < max(rng.uniform(0.04, 0.12), 2 / (radius * CAMERA.fx))) & (abs(dy) < 1)
    if shape == "diagonal":
        width = max(rng.uniform(0.08, 0.2), 2 / (radius * CAMERA.fx))
        return (abs(dx - dy) < width) & (abs(dx) < 1) & (abs(dy) < 1)
    if shape == "frame":
        inner = 1 - max(rng.uniform(0.1, 0.2), 2 / (radius * CAMERA.fx))
        outside = np.maximum(abs(dx), abs(dy))
        return (outside < 1) & (outside > inner)
    return (abs(dx) < aspect) & (abs(dy) < 1)


def _sphere(depth_m: float, radius: float, centre_xy: tuple[float, float]) -> NDArray[np.float64]:
    """Sphere whose nearest point is about `depth_m` away."""
    metres = min(depth_m * radius, 0.4)
    x, y, z = (np.array([*centre_xy, 1.0]) * (depth_m + metres)).tolist()
    return Sphere((x, y, z), metres).depth_m(np.zeros(3), np.stack(rays()))


def _occluder(rng: np.random.Generator, surface: NDArray[np.float64]) -> NDArray[np.float64]:
    """Depth (H, W) of a nearer board over half of the object, infinite beside it."""
    left, top, right, bottom = tight_box(np.isfinite(surface))
    depth_m = rng.uniform(0.5, 0.85) * float(surface.min())
    covered = np.full_like(surface, np.inf)
    reach_x, reach_y = max(right - left, bottom - top) * rng.uniform(0.3, 1.0, 2)
    edges = np.array([left - reach_x, top - reach_y, right + reach_x, bottom + reach_y])
    half = rng.integers(0, 4)  # which side of it stays visible
    edges[half] = ((left + right) / 2, (top + bottom) / 2)[half % 2]
    x1, y1, x2, y2 = np.maximum(np.rint(edges), 0).astype(int).tolist()
    covered[y1:y2, x1:x2] = depth_m
    return covered


def _floor_below(surface: NDArray[np.float64]) -> NDArray[np.float64]:
    """Depth (H, W) of a floor on which the object stands, and of a wall behind it."""
    bottom = tight_box(np.isfinite(surface))[3]
    depth_m = float(np.min(surface[bottom - 1]))
    _, y, _ = rays()
    height_m = max(y[bottom - 1, 0], 0.1) * depth_m
    return np.asarray(np.minimum(height_m / np.maximum(y, 1e-3), 3 * depth_m), np.float64)


def _beside(rng: np.random.Generator, surface: NDArray[np.float64]) -> NDArray[np.float64]:
    """Depth (H, W) of the same surface moved to either side, infinite elsewhere."""
    left, _, right, _ = tight_box(np.isfinite(surface))
    beside = np.full_like(surface, np.inf)
    shift = round((right - left) * rng.uniform(1.05, 1.3)) + 1
    if shift < surface.shape[1]:
        beside[:, shift:] = surface[:, :-shift]
        beside[:, :-shift] = np.minimum(beside[:, :-shift], surface[:, shift:])
    return beside


def bounds(
    surface: NDArray[np.float64], camera: Intrinsics = CAMERA
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Lower and upper corner (3,) of the surface's bounding box in metres."""
    seen = np.isfinite(surface)
    points = np.stack(rays(camera))[:, seen] * surface[seen]
    return points.min(axis=1), points.max(axis=1)


def tight_box(seen: NDArray[np.bool_]) -> tuple[int, int, int, int]:
    columns, rows = np.flatnonzero(seen.any(axis=0)), np.flatnonzero(seen.any(axis=1))
    return int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1


def jittered_box(rng: np.random.Generator, seen: NDArray[np.bool_]) -> NDArray[np.float32]:
    left, top, right, bottom = tight_box(seen)
    sides = np.array([right - left, bottom - top] * 2)
    box = np.array([left, top, right, bottom]) + rng.uniform(-_BOX_JITTER, _BOX_JITTER, 4) * sides
    height, width = CAMERA.size_hw
    return np.asarray(np.clip(box, 0, [width, height, width, height]), np.float32)


def measured_by_a_sensor(
    rng: np.random.Generator, depth_m: NDArray[np.float64], hole_share: float
) -> NDArray[np.float32]:
    """What a sensor makes of the true depth (H, W)."""
    mixed = depth_m.copy()
    for axis in (0, 1):
        jump = abs(np.diff(depth_m, axis=axis)) > 0.05 * depth_m.min()
        rows, columns = np.nonzero(jump & (rng.random(jump.shape) < 0.5))
        beside = (rows + 1, columns) if axis == 0 else (rows, columns + 1)
        weight = rng.random(rows.size)
        mixed[rows, columns] = weight * depth_m[rows, columns] + (1 - weight) * depth_m[beside]
    measured: NDArray[np.float64] = mixed + rng.normal(0, _NOISE_PER_M, mixed.shape) * mixed**2
    measured[_holes(rng, hole_share) | (measured > REACH_M)] = 0
    return measured.astype(np.float32)


def _holes(rng: np.random.Generator, share: float) -> NDArray[np.bool_]:
    """Pixels (H, W) without a measurement."""
    height, width = CAMERA.size_hw
    holes = np.zeros((height, width), np.bool_)
    while holes.mean() < share / 2:
        size_y, size_x = rng.integers(3, 16, 2)
        y, x = rng.integers(0, height), rng.integers(0, width)
        holes[y : y + size_y, x : x + size_x] = True
    return holes | (rng.random(holes.shape) < (share / 2) / (1 - share / 2))
