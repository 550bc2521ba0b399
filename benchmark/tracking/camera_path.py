"""Where a camera on a robot looks, as a function of time."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.sources.scene import Shape

SIZE_HW = (480, 640)
DURATION_S = 10.0
FOCAL_PX = 550.0
HEIGHT_M = 0.8
"""Of a camera that drives, above the floor."""
MIN_DEPTH_M = 1.2
"""Nearer objects are beside or behind the camera."""
_OUT_XY = (-1e4, -1e4)
Matrix = NDArray[np.float64]


@dataclass(frozen=True)
class Pose:
    """How the image differs from that of a camera that stands still at the middle of the scene."""

    shift_xy: tuple[float, float] = (0.0, 0.0)
    """Pixels: sway, which moves far and near alike, as small rotations do."""
    yaw: float = 0.0
    """Radians."""
    roll: float = 0.0
    """Radians."""
    forward_m: float | None = None
    """Distance driven; None for a camera that does not drive."""

    @property
    def rotation(self) -> Matrix:
        """(3, 3) homography of yaw, roll and sway."""
        width, height = SIZE_HW[1] / 2, SIZE_HW[0] / 2
        camera = np.array(((FOCAL_PX, 0, width), (0, FOCAL_PX, height), (0, 0, 1)))
        (sin_yaw, cos_yaw), (sin, cos) = ((math.sin(a), math.cos(a)) for a in (self.yaw, self.roll))
        yaw = np.array(((cos_yaw, 0, sin_yaw), (0, 1, 0), (-sin_yaw, 0, cos_yaw)))
        roll = np.array(((cos, -sin, 0), (sin, cos, 0), (0, 0, 1)))
        sway = np.array(((1, 0, self.shift_xy[0]), (0, 1, self.shift_xy[1]), (0, 0, 1)))
        return np.asarray(sway @ camera @ roll @ yaw @ np.linalg.inv(camera))

    def plane(self, depth_m: float) -> Matrix:
        """(3, 3) homography of what is `depth_m` away at the middle of the scene."""
        scale = 1.0 if self.forward_m is None else depth_m / max(depth_m - self.forward_m, MIN_DEPTH_M)
        centre = np.array(SIZE_HW[::-1]) / 2
        zoom = np.array(((scale, 0, centre[0]), (0, scale, centre[1]), (0, 0, 1)))
        return np.asarray(self.rotation @ zoom @ _moved(-centre))

    def floor(self, pixels_per_m: float) -> Matrix:
        """(3, 3) homography from a map of the floor, x to the right and y ahead, to the image."""
        distance = (self.forward_m or 0.0) * pixels_per_m
        right_down_ahead = np.array(((1, 0, 0), (0, 0, HEIGHT_M * pixels_per_m), (0, 1, -distance)))
        width, height = SIZE_HW[1] / 2, SIZE_HW[0] / 2
        camera = np.array(((FOCAL_PX, 0, width), (0, FOCAL_PX, height), (0, 0, 1)))
        return np.asarray(self.rotation @ camera @ right_down_ahead)

    def seen(self, shape: Shape, depth_m: float) -> Shape:
        """The `shape` in the image, far outside if the camera has passed it."""
        if self.forward_m is not None and depth_m - self.forward_m <= MIN_DEPTH_M:
            return replace(shape, centre_xy=_OUT_XY)
        matrix = self.plane(depth_m)
        x, y = shape.centre_xy
        (centre, beside) = projected(matrix, np.array(((x, y), (x, y + 1.0))))
        scale = float(np.linalg.norm(beside - centre))
        return replace(
            shape,
            centre_xy=(float(centre[0]), float(centre[1])),
            radius=shape.radius * scale,
            angle=shape.angle + self.roll,
        )

    def seen_box(self, box_xyxy: Sequence[float], depth_m: float = 5.0) -> Matrix:
        """A box (4,) in the image, moved and resized but not turned."""
        x1, y1, x2, y2 = box_xyxy
        middle = np.array(((x1 + x2) / 2, (y1 + y2) / 2))
        centre, beside = projected(self.plane(depth_m), np.stack((middle, middle + np.array((1, 0)))))
        half = np.array((x2 - x1, y2 - y1)) / 2 * float(np.linalg.norm(beside - centre))
        return np.concatenate((centre - half, centre + half))


CameraPath = Callable[[float], Pose]
"""The pose at a time in seconds, from 0 to DURATION_S."""


def projected(matrix: Matrix, points_xy: Matrix) -> Matrix:
    """Points (n, 2) mapped by a homography (3, 3)."""
    mapped = np.column_stack((points_xy, np.ones(len(points_xy)))) @ matrix.T
    return np.asarray(mapped[:, :2] / mapped[:, 2:])


def _moved(shift_xy: Matrix) -> Matrix:
    matrix = np.eye(3)
    matrix[:2, 2] = shift_xy
    return matrix


def still(_: float) -> Pose:
    """A camera that stands still."""
    return Pose()


def _sway(amplitude_px: float, rate_hz: float, rng: np.random.Generator) -> CameraPath:
    """To the sides, and a quarter as far up and down, twice as often, as a walk does."""
    phase, phase_y = rng.uniform(0, 2 * math.pi, 2)

    def pose(time_s: float) -> Pose:
        angle = 2 * math.pi * rate_hz * time_s
        return Pose(
            (amplitude_px * math.sin(angle + phase), amplitude_px / 4 * math.sin(2 * angle + phase_y))
        )

    return pose


def _yaw(rng: np.random.Generator) -> CameraPath:
    """Turns of 15 to 30 degrees within 0.8 s, alternately to both sides, with pauses."""
    turns = [
        (start_s, side * math.radians(rng.uniform(15, 30)))
        for start_s, side in zip(np.arange(0.7, DURATION_S, 1.9).tolist(), (1, -1, -1, 1, 1), strict=True)
    ]

    def pose(time_s: float) -> Pose:
        done = [(min(max((time_s - start_s) / 0.8, 0.0), 1.0), angle) for start_s, angle in turns]
        return Pose(yaw=sum(angle * (3 * x**2 - 2 * x**3) for x, angle in done))

    return pose


def _roll(rng: np.random.Generator) -> CameraPath:
    """By up to 10 degrees to both sides, every two seconds."""
    phase = rng.uniform(0, 2 * math.pi)
    return lambda time_s: Pose(roll=math.radians(10) * math.sin(math.pi * time_s + phase))


def _drive(rng: np.random.Generator) -> CameraPath:
    """Forward at 0.5 to 1 m/s, faster and slower, on a floor that makes the camera nod by 6 pixels."""
    speed, phase, nod = rng.uniform(0.5, 1.0), *rng.uniform(0, 2 * math.pi, 2)

    def pose(time_s: float) -> Pose:
        forward_m = speed * (time_s - DURATION_S / 2 + 0.4 * math.sin(1.5 * time_s + phase))
        return Pose((0.0, 6 * math.sin(2 * math.pi * 1.3 * time_s + nod)), forward_m=forward_m)

    return pose


def _vibration(rng: np.random.Generator) -> CameraPath:
    """Twelve vibrations of 2 to 20 Hz in x, y and roll, together about 5 pixels and 0.2 degrees."""
    rates, phases = rng.uniform(2, 20, (3, 12)), rng.uniform(0, 2 * math.pi, (3, 12))

    def pose(time_s: float) -> Pose:
        x, y, roll = np.sin(2 * math.pi * rates * time_s + phases).sum(axis=1) / math.sqrt(6)
        return Pose((5 * x, 5 * y), roll=math.radians(0.2) * roll)

    return pose


CAMERA_PATHS: Mapping[str, Callable[[np.random.Generator], CameraPath]] = MappingProxyType(
    {
        **{
            f"sway {amplitude_px} {rate_hz}": partial(_sway, amplitude_px, rate_hz)
            for amplitude_px, rate_hz in ((40, 0.8), (70, 0.4), (40, 0.4), (70, 0.2))
        },
        "yaw": _yaw,
        "roll": _roll,
        "drive": _drive,
        "vibration": _vibration,
    }
)
"""Sways are named by pixels to each side and Hz."""
