"""Solids made of cuboids, upright cylinders and spheres on a floor, and their depth along rays.

Coordinates in metres: x right, y up from the floor, z away from the camera, before the object is turned.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Points = NDArray[np.float64]

_LIMIT = 1e-9  # a ray's slope that counts as parallel


@dataclass(frozen=True)
class Cuboid:
    """Axis-parallel, from one corner to the opposite one."""

    lower_xyz_m: tuple[float, float, float]
    upper_xyz_m: tuple[float, float, float]

    @property
    def corners(self) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
        return self.lower_xyz_m, self.upper_xyz_m

    def depth_m(self, origin: Points, rays: Points) -> Points:
        """Depth (H, W) along the rays (3, H, W), infinite where they miss."""
        spans = [
            _slab(o, ray, low, high) for o, ray, low, high in zip(origin, rays, *self.corners, strict=True)
        ]
        return _entered(*spans)


@dataclass(frozen=True)
class Cylinder:
    """Upright, from its foot's height to its top's."""

    x_m: float
    z_m: float
    radius_m: float
    foot_m: float
    top_m: float

    @property
    def corners(self) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
        radius = self.radius_m
        return (
            (self.x_m - radius, self.foot_m, self.z_m - radius),
            (self.x_m + radius, self.top_m, self.z_m + radius),
        )

    def depth_m(self, origin: Points, rays: Points) -> Points:
        """Depth (H, W) along the rays (3, H, W), infinite where they miss."""
        offset = origin[[0, 2]] - (self.x_m, self.z_m)
        wall = _round(offset, rays[[0, 2]], self.radius_m)
        return _entered(wall, _slab(origin[1], rays[1], self.foot_m, self.top_m))


@dataclass(frozen=True)
class Sphere:
    """A head."""

    centre_xyz_m: tuple[float, float, float]
    radius_m: float

    @property
    def corners(self) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
        x, y, z = self.centre_xyz_m
        radius = self.radius_m
        return (x - radius, y - radius, z - radius), (x + radius, y + radius, z + radius)

    def depth_m(self, origin: Points, rays: Points) -> Points:
        """Depth (H, W) along the rays (3, H, W), infinite where they miss."""
        return _entered(_round(origin - self.centre_xyz_m, rays, self.radius_m))


Part = Cuboid | Cylinder | Sphere


def _block(width: float, foot: float, top: float, length: float, x: float = 0.0, z: float = 0.0) -> Cuboid:
    """A cuboid around the vertical line through (x, z)."""
    return Cuboid((x - width / 2, foot, z - length / 2), (x + width / 2, top, z + length / 2))


def _cuboid(rng: np.random.Generator) -> tuple[Part, ...]:
    width, height, length = np.exp(rng.uniform(math.log(0.15), math.log(0.9), 3)).tolist()
    return (_block(width, 0, height, length),)


def _cylinder(rng: np.random.Generator) -> tuple[Part, ...]:
    return (Cylinder(0, 0, rng.uniform(0.05, 0.35), 0, math.exp(rng.uniform(math.log(0.15), 0))),)


def _person(rng: np.random.Generator) -> tuple[Part, ...]:
    height = rng.uniform(1.1, 1.95)
    hip, neck, head = 0.48 * height, 0.84 * height, 0.065 * height
    width, stride = rng.uniform(0.2, 0.28) * height, rng.uniform(-0.15, 0.15)
    legs = [Cylinder(side * 0.25 * width, side * stride, 0.045 * height, 0, hip) for side in (-1, 1)]
    arm = _block(0.09, 0.9 * hip, 0.6 * height, rng.uniform(0.1, 0.4), rng.choice((-0.5, 0.5)) * width, -0.1)
    chest = _block(width, hip, neck, 0.13 * height)
    return (*legs, chest, arm, Sphere((0, neck + 1.2 * head, 0), head))


def _legs(rng: np.random.Generator, width: float, length: float, top: float) -> list[Part]:
    """Four thin legs at the corners."""
    side = rng.uniform(0.025, 0.06)
    x, z = (width - side) / 2, (length - side) / 2
    return [_block(side, 0, top, side, a * x, b * z) for a in (-1, 1) for b in (-1, 1)]


def _table(rng: np.random.Generator) -> tuple[Part, ...]:
    width, length, top = rng.uniform(0.5, 1.5), rng.uniform(0.45, 0.9), rng.uniform(0.4, 0.9)
    board = top - rng.uniform(0.02, 0.05)
    return (_block(width, board, top, length), *_legs(rng, width, length, board))


def _chair(rng: np.random.Generator) -> tuple[Part, ...]:
    width, length, seat = rng.uniform(0.38, 0.55), rng.uniform(0.38, 0.55), rng.uniform(0.4, 0.5)
    top, thick = seat + rng.uniform(0.35, 0.55), rng.uniform(0.02, 0.05)
    back = _block(width, seat, top, thick, z=(length - thick) / 2)
    return (_block(width, seat - thick, seat, length), back, *_legs(rng, width, length, seat - thick))


def _shelf(rng: np.random.Generator) -> tuple[Part, ...]:
    width, height, length = rng.uniform(0.5, 1.0), rng.uniform(0.7, 1.9), rng.uniform(0.22, 0.4)
    thick, boards = 0.025, int(rng.integers(3, 6))
    sides = [_block(thick, 0, height, length, a * (width - thick) / 2) for a in (-1, 1)]
    heights = np.linspace(0.05, height - thick, boards)
    shelves = [_block(width, low, low + thick, length) for low in heights.tolist()]
    panel = [_block(width, 0, height, 0.01, z=length / 2)] if rng.random() < 0.5 else []
    return (*sides, *shelves, *panel)


KINDS: Mapping[str, Callable[[np.random.Generator], tuple[Part, ...]]] = {
    "cuboid": _cuboid,
    "cylinder": _cylinder,
    "person": _person,
    "table": _table,
    "chair": _chair,
    "shelf": _shelf,
}
"""Makers of objects of everyday size, on the floor around (0, 0, 0)."""

_Span = tuple[Points, Points]


def _slab(origin: float, ray: Points, low: float, high: float) -> _Span:
    """Where rays enter and leave the space between two planes."""
    safe = np.where(abs(ray) < _LIMIT, _LIMIT, ray)
    one, other = (low - origin) / safe, (high - origin) / safe
    return np.minimum(one, other), np.maximum(one, other)


def _round(offset: Points, rays: Points, radius: float) -> _Span:
    """Where rays enter and leave a circle or sphere around 0."""
    squared = (rays**2).sum(axis=0)
    along = np.tensordot(offset, rays, 1) / squared
    root = along**2 - (offset @ offset - radius**2) / squared
    half = np.where(root > 0, np.sqrt(np.maximum(root, 0)), -np.inf)
    return -along - half, -along + half


def _entered(*spans: _Span) -> Points:
    """Where rays enter what all the convex spaces have in common, infinite where they miss it."""
    near = np.maximum.reduce([span[0] for span in spans])
    far = np.minimum.reduce([span[1] for span in spans])
    return np.where((near < far) & (near > 0), near, np.inf)
