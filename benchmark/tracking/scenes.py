"""Scenes of moving shapes whose identities are known."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from benchmark.tracking.camera_path import CAMERA_PATHS, DURATION_S, SIZE_HW, CameraPath, still
from yolov5_lifecycle.sources.scene import CLASS_NAMES, Shape

MIN_VISIBLE = 0.25
"""Share of a box that must be uncovered and inside the image for the object to count as present."""
_CELLS = 24
"""Along each side of a box; a cell is seen or covered as a whole."""


@dataclass(frozen=True)
class Actor:
    """A shape on its way: a straight line, and a swing around it."""

    class_id: int
    radius: float
    angle: float
    colour: tuple[int, int, int]
    centre_xy: tuple[float, float]
    """At the middle of the scene, in pixels."""
    velocity_xy: tuple[float, float] = (0.0, 0.0)
    """Pixels per second."""
    swing_xy: tuple[float, float] = (0.0, 0.0)
    """Pixels."""
    swing_rate: float = 0.0
    """Radians per second."""
    phase: float = 0.0
    depth_m: float = 10.0
    """Distance from a camera that drives, at the middle of the scene."""

    def shape(self, time_s: float) -> Shape:
        """Where it is at `time_s`, seen by a still camera."""
        swing = math.sin(self.swing_rate * time_s + self.phase)
        x, y = (
            start + speed * (time_s - DURATION_S / 2) + width * swing
            for start, speed, width in zip(self.centre_xy, self.velocity_xy, self.swing_xy, strict=True)
        )
        return Shape(self.class_id, (x, y), self.radius, self.angle, self.colour)


@dataclass(frozen=True, eq=False)
class View:
    """What a camera sees, the furthest actor first."""

    shapes: tuple[Shape, ...]
    boxes_xyxy: NDArray[np.float32]
    """Boxes (n, 4) of the visible part of each, as detectors find it; empty if invisible."""
    visible: NDArray[np.float64]
    """Visible share (n,) of each."""
    walls_xyxy: NDArray[np.float64]
    """(m, 4), before all of them, upright."""


@dataclass(frozen=True)
class TrackScene:
    """Actors, the furthest first, and walls before all of them, seen by a camera."""

    name: str
    actors: tuple[Actor, ...]
    walls_xyxy: tuple[tuple[float, float, float, float], ...] = ()
    camera: CameraPath = still
    has_pauses: bool = False
    """Whether images are missing for up to 0.6 s, again and again."""

    def view(self, time_s: float) -> View:
        """The scene at `time_s`."""
        pose = self.camera(time_s)
        shapes = tuple(pose.seen(actor.shape(time_s), actor.depth_m) for actor in self.actors)
        whole = np.array([_box(shape) for shape in shapes])
        walls = np.array([pose.seen_box(wall) for wall in self.walls_xyxy]).reshape(-1, 4)
        seen = [_seen(box, np.vstack((whole[row + 1 :], walls))) for row, box in enumerate(whole)]
        boxes_xyxy = np.array([_seen_box(box, cells) for box, cells in zip(whole, seen, strict=True)])
        visible = np.array([cells.mean() for cells in seen])
        return View(shapes, boxes_xyxy.astype(np.float32), visible, walls)

    def image(self, view: View, background: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """An RGB image (H, W, 3) of `view` on a `background` of SIZE_HW; the walls look like that, too."""
        pixels = background.copy()
        for shape in view.shapes:
            shape.draw(pixels)
        for wall in view.walls_xyxy:
            left, top, right, bottom = (max(round(side), 0) for side in wall.tolist())
            pixels[top:bottom, left:right] = background[top:bottom, left:right]
        return pixels


def _box(shape: Shape) -> NDArray[np.float64]:
    corners = shape.outline()
    return np.concatenate((corners.min(axis=0), corners.max(axis=0)))


def _seen(box_xyxy: NDArray[np.float64], covers_xyxy: NDArray[np.float64]) -> NDArray[np.bool_]:
    """The cells (rows, columns) of a box whose middle is inside the image and in no cover (n, 4)."""
    middles = (np.arange(_CELLS) + 0.5) / _CELLS
    x, y = box_xyxy[:2, None] + middles * (box_xyxy[2:] - box_xyxy[:2])[:, None]
    y = y[:, None]
    seen: NDArray[np.bool_] = (x >= 0) & (x < SIZE_HW[1]) & (y >= 0) & (y < SIZE_HW[0])
    for left, top, right, bottom in covers_xyxy:
        seen &= (x < left) | (x >= right) | (y < top) | (y >= bottom)
    return seen


def _seen_box(box_xyxy: NDArray[np.float64], seen: NDArray[np.bool_]) -> NDArray[np.float64]:
    """The corners of the `seen` cells of a box; zeros without any."""
    columns, rows = np.flatnonzero(seen.any(axis=0)), np.flatnonzero(seen.any(axis=1))
    if not len(rows):
        return np.zeros(4)
    low, high = np.array((columns[0], rows[0])), np.array((columns[-1], rows[-1])) + 1
    cell = (box_xyxy[2:] - box_xyxy[:2]) / _CELLS
    return np.concatenate((box_xyxy[:2] + low * cell, box_xyxy[:2] + high * cell))


def crossings(rng: np.random.Generator) -> TrackScene:
    """Four pairs of the same class that meet and pass each other."""
    actors = []
    for lane in range(4):
        class_id, y = _some_class(rng), 75.0 + 110 * lane
        for direction in (1, -1):
            speed = direction * rng.uniform(30, 120)
            centre_xy = (320 + rng.uniform(-40, 40), y + rng.uniform(-12, 12))
            actors.append(_actor(rng, class_id, centre_xy, velocity_xy=(speed, rng.uniform(-3, 3))))
    return TrackScene("crossings", tuple(actors))


def occlusions(rng: np.random.Generator) -> TrackScene:
    """Four that each pass behind two walls, which hide them for 0.2 to 1 s."""
    actors: list[Actor] = []
    walls = []
    for lane in range(4):
        y, speed = 65.0 + 115 * lane, rng.choice((-1, 1)) * rng.uniform(60, 110)
        actor = _actor(rng, _some_class(rng), (320, y), velocity_xy=(speed, 0))
        actors.append(actor)
        for x in (180, 440):
            half_width = actor.radius / 2 + abs(speed) * rng.uniform(0.2, 1.0) / 2
            walls.append((x - half_width, y - 56, x + half_width, y + 56))
    return TrackScene("occlusions", tuple(actors), tuple(walls))


def returns(rng: np.random.Generator) -> TrackScene:
    """Six objects that leave the image and come back with a new identity, as a tracker cannot know."""
    actors = [
        _actor(
            rng,
            _some_class(rng),
            (rng.choice((60, 580)), 50.0 + 75 * lane),
            swing_xy=(rng.uniform(130, 180), 8),
            swing_rate=rng.uniform(0.7, 1.3),
        )
        for lane in range(6)
    ]
    return TrackScene("returns", tuple(actors))


def crowd(rng: np.random.Generator) -> TrackScene:
    """Twelve objects of two classes that swing across the image, in front of and behind each other."""
    classes = rng.choice(len(CLASS_NAMES), 2, replace=False)
    actors = [
        _actor(
            rng,
            int(classes[number % 2]),
            (rng.uniform(150, 490), rng.uniform(110, 370)),
            swing_xy=(rng.uniform(40, 140), rng.uniform(20, 100)),
            swing_rate=rng.uniform(0.3, 1.1),
        )
        for number in range(12)
    ]
    return TrackScene("crowd", tuple(actors))


def street(rng: np.random.Generator) -> TrackScene:
    """Twelve objects of three classes that wander, some beside the image at first, behind two pillars."""
    classes = rng.choice(len(CLASS_NAMES), 3, replace=False)
    actors = [
        replace(
            _actor(
                rng,
                int(classes[number % 3]),
                (rng.uniform(-120, 760), rng.uniform(60, 420)),
                velocity_xy=(rng.choice((-1, 1)) * rng.uniform(10, 60), rng.uniform(-6, 6)),
                swing_xy=(rng.uniform(0, 25), rng.uniform(0, 10)),
                swing_rate=rng.uniform(0.5, 1.5),
            ),
            depth_m=depth_m,
        )
        for number, depth_m in enumerate(np.linspace(16, 6, 12).tolist())
    ]
    walls = tuple((x - 22, -200.0, x + 22, 700.0) for x in rng.uniform((80, 380), (260, 560)).tolist())
    return TrackScene("street", tuple(actors), walls)


def _driven(
    name: str, path: Callable[[np.random.Generator], CameraPath], pauses: bool, rng: np.random.Generator
) -> TrackScene:
    """The street from a camera that moves."""
    scene = street(rng)
    return replace(scene, name=name, camera=path(rng), has_pauses=pauses)


STILL_SCENES: Mapping[str, Callable[[np.random.Generator], TrackScene]] = MappingProxyType(
    {
        **{scene.__name__: scene for scene in (crossings, occlusions, returns, crowd, street)},
        "pauses": partial(_driven, "pauses", lambda _: still, True),
    }
)
"""The camera stands still."""
MOVING_SCENES: Mapping[str, Callable[[np.random.Generator], TrackScene]] = MappingProxyType(
    {
        **{name: partial(_driven, name, path, False) for name, path in CAMERA_PATHS.items()},
        "sway, pauses": partial(_driven, "sway, pauses", CAMERA_PATHS["sway 40 0.4"], True),
    }
)
"""The camera is on a robot that moves."""
SCENES = MappingProxyType({**STILL_SCENES, **MOVING_SCENES})


def _some_class(rng: np.random.Generator) -> int:
    return int(rng.integers(len(CLASS_NAMES)))


def _actor(
    rng: np.random.Generator,
    class_id: int,
    centre_xy: tuple[float, float],
    *,
    velocity_xy: tuple[float, float] = (0.0, 0.0),
    swing_xy: tuple[float, float] = (0.0, 0.0),
    swing_rate: float = 0.0,
) -> Actor:
    red, green, blue = rng.choice((20, 235), 3).tolist()  # far from the grey that they are drawn on
    return Actor(
        class_id=class_id,
        radius=rng.uniform(24, 46),
        angle=rng.uniform(0, 2 * math.pi),
        colour=(red, green, blue),
        centre_xy=centre_xy,
        velocity_xy=velocity_xy,
        swing_xy=swing_xy,
        swing_rate=swing_rate,
        phase=rng.uniform(0, 2 * math.pi),
    )
