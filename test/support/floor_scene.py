"""Rendered depth images of solids on a floor, seen from above, with ground truth in metres."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from support.depth_scene import (
    CAMERA,
    DepthScene,
    bounds,
    jittered_box,
    measured_by_a_sensor,
    pixels,
    rays,
    tight_box,
)
from support.solids import KINDS, Part
from yolov5_lifecycle.spatial.camera_model import Intrinsics

Array = NDArray[np.float64]

CAMERA_HEIGHTS_M = (0.3, 2.0)
MAX_PITCH = math.radians(45)
_RANGES_M = (0.6, 7.0)
_MIN_SIDE_PX = 16
_EDGE_PX = 2  # objects end at least that far from the edge of the image
_SHOWN = (0.3, 0.75)  # of the pixels of what a crate hides a part of


@dataclass(frozen=True)
class View:
    """A camera above the floor, looking down by `pitch`, and an object, turned by `yaw`, both in radians."""

    height_m: float
    pitch: float
    x_m: float
    z_m: float
    yaw: float

    def local(self, directions: Array) -> Array:
        """Directions (3, ...) of the optical frame in the axes of the object."""
        x, down, forward = directions
        up = -down * math.cos(self.pitch) - forward * math.sin(self.pitch)
        away = forward * math.cos(self.pitch) - down * math.sin(self.pitch)
        c, s = math.cos(self.yaw), math.sin(self.yaw)
        return np.stack((c * x - s * away, up, s * x + c * away))

    @property
    def origin(self) -> Array:
        """The camera in the coordinates of the object."""
        c, s = math.cos(self.yaw), math.sin(self.yaw)
        return np.array(
            (-c * self.x_m + s * self.z_m, self.height_m, -s * self.x_m - c * self.z_m), np.float64
        )

    def tangents(self, points: Array) -> Array:
        """x / z and y / z (2, n) of points (3, n) in the coordinates of the object; NaN behind the camera."""
        axes = self.local(np.eye(3))  # the optical axes, one a column
        x, y, z = axes.T @ (points - self.origin[:, None])
        z = np.where(z > 0.1, z, np.nan)
        return np.stack((x / z, y / z))


def random_floor_scene(
    rng: np.random.Generator,
    kind: str,
    *,
    is_ideal: bool = False,
    has_company: bool = False,
    is_half_hidden: bool = False,
    is_between_walls: bool = False,
    camera: Intrinsics = CAMERA,
) -> DepthScene:
    """An object on a floor before a wall, entirely in the image.

    `is_ideal`: the depth of each pixel is exact and the box is tight. Otherwise the depth has noise, mixed
    pixels and 30 % holes, and the sides of the box are off. `has_company`: two other objects stand nearby.
    `is_half_hidden`: a crate stands before it. `is_between_walls`: there are walls on both sides, too.
    `camera` has an image of the size of CAMERA.
    """
    least, most = _SHOWN if is_half_hidden else (0.7, 1.0)
    while True:
        view, parts = _random_view(rng), KINDS[kind](rng)
        if not _fits(view, parts, camera):
            continue
        surface = rendered(view, parts, camera)
        others = np.full_like(surface, np.inf)
        if has_company:
            others = _company(rng, view, camera)
        if is_half_hidden:
            others = np.minimum(others, _crate_before(rng, view, camera))
        seen = np.isfinite(surface) & (surface < others)
        if seen.sum() >= 40 and least <= seen.sum() / np.isfinite(surface).sum() <= most:
            break
    turned, wall_m = rng.uniform(-0.6, 0.6), rng.uniform(1.0, 5.0)
    around = room(view, turned=turned, wall_m=wall_m, camera=camera)
    if is_between_walls:
        away_m = float(np.ptp([part.corners for part in parts], axis=(0, 1)).max())
        around = np.minimum(around, _side_walls(rng, view, turned, away_m, camera))
    depth_m = np.fmin(np.minimum(surface, others), around)
    lower, upper = bounds(np.where(seen, surface, np.inf), camera)
    return DepthScene(
        depth_m=_exact(depth_m) if is_ideal else measured_by_a_sensor(rng, depth_m, 0.3),
        box_xyxy=np.array(tight_box(seen), np.float32) if is_ideal else jittered_box(rng, seen),
        centre_xyz_m=(lower + upper) / 2,
        size_xyz_m=upper - lower,
        mask=seen,
        hidden_share=1 - float(seen.sum() / np.isfinite(surface).sum()),
        camera=camera,
    )


def rendered(view: View, parts: tuple[Part, ...], camera: Intrinsics = CAMERA) -> Array:
    """Depth (H, W) of an object, infinite beside it."""
    directions = view.local(np.stack(rays(camera)))
    depth_m: Array = np.minimum.reduce([part.depth_m(view.origin, directions) for part in parts])
    return depth_m


def _random_view(rng: np.random.Generator) -> View:
    away_m = math.exp(rng.uniform(*np.log(_RANGES_M)))
    return View(
        height_m=rng.uniform(*CAMERA_HEIGHTS_M),
        pitch=rng.uniform(0, MAX_PITCH),
        x_m=away_m * rng.uniform(-0.5, 0.5),
        z_m=away_m,
        yaw=rng.uniform(0, 2 * math.pi),
    )


def _fits(view: View, parts: tuple[Part, ...], camera: Intrinsics) -> bool:
    """Whether all of the object is in the image, and large enough."""
    corners = [
        np.array([(x, y, z) for x in xs for y in ys for z in zs]).T
        for xs, ys, zs in (zip(*part.corners, strict=True) for part in parts)
    ]
    places = pixels(camera, view.tangents(np.concatenate(corners, axis=1)))
    height, width = CAMERA.size_hw
    ends = np.array(((width,), (height,))) - 1 - _EDGE_PX
    is_inside = bool(((places >= _EDGE_PX) & (places <= ends)).all())
    return is_inside and bool((np.ptp(places, axis=1) >= _MIN_SIDE_PX).all())


def _company(rng: np.random.Generator, view: View, camera: Intrinsics) -> Array:
    """Depth (H, W) of two other objects half a metre to two metres beside, before or behind."""
    found = []
    for kind in ("cuboid", "person"):
        angle, metres = rng.uniform(0, 2 * math.pi), rng.uniform(0.6, 2.0)
        x_m, z_m = view.x_m + metres * math.sin(angle), view.z_m + metres * math.cos(angle)
        other = View(view.height_m, view.pitch, x_m, max(z_m, 0.5), rng.uniform(0, 2 * math.pi))
        found.append(rendered(other, KINDS[kind](rng), camera))
    return np.minimum(*found)


def _crate_before(rng: np.random.Generator, view: View, camera: Intrinsics) -> Array:
    """Depth (H, W) of a cuboid at half to three quarters of the way to the object."""
    share = rng.uniform(0.45, 0.75)
    x_m, z_m = share * view.x_m + rng.uniform(-0.4, 0.4), share * view.z_m - 0.1
    crate = View(view.height_m, view.pitch, x_m, z_m, rng.uniform(0, 2 * math.pi))
    return rendered(crate, KINDS["cuboid"](rng), camera)


def _side_walls(
    rng: np.random.Generator, view: View, turned: float, away_m: float, camera: Intrinsics
) -> Array:
    """Depth (H, W) of two walls, at least that far to the left and right of the camera and the object."""
    x, _, _ = View(view.height_m, view.pitch, 0, 0, turned).local(np.stack(rays(camera)))
    object_x_m = math.cos(turned) * view.x_m - math.sin(turned) * view.z_m
    found: Array = np.full_like(x, np.inf)
    for side in (-1, 1):
        wall_m = max(side * object_x_m, 0) + away_m + rng.uniform(0.05, 1.5)
        found = np.minimum(found, np.where(side * x > 1e-6, wall_m / np.maximum(side * x, 1e-6), np.inf))
    return found


def room(view: View, wall_m: float, turned: float = 0.0, camera: Intrinsics = CAMERA) -> Array:
    """Depth (H, W) of the floor and of an upright wall that far behind the middle of the object."""
    _, up, away = View(view.height_m, view.pitch, 0, 0, turned).local(np.stack(rays(camera)))
    floor = np.where(up < -1e-6, view.height_m / np.maximum(-up, 1e-6), np.inf)
    nearest_m = math.sin(turned) * view.x_m + math.cos(turned) * view.z_m
    wall = np.where(away > 1e-6, (nearest_m + wall_m) / np.maximum(away, 1e-6), np.inf)
    return np.minimum(floor, wall)


def _exact(depth_m: Array) -> NDArray[np.float32]:
    return np.where(np.isfinite(depth_m), depth_m, 0).astype(np.float32)
