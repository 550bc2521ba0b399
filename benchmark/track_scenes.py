"""Scenes of moving shapes whose identities are known."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.sources.scene import CLASS_NAMES, Shape

SIZE_HW = (480, 640)
DURATION_S = 10.0
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

    def shape(self, time_s: float) -> Shape:
        """Where it is at `time_s`."""
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


@dataclass(frozen=True)
class TrackScene:
    """Actors, the furthest first, and walls before all of them."""

    name: str
    actors: tuple[Actor, ...]
    walls_xyxy: tuple[tuple[float, float, float, float], ...] = ()

    def view(self, time_s: float) -> View:
        """The scene at `time_s`."""
        shapes = tuple(actor.shape(time_s) for actor in self.actors)
        whole = np.array([_box(shape) for shape in shapes])
        walls = np.array(self.walls_xyxy).reshape(-1, 4)
        seen = [_seen(box, np.vstack((whole[row + 1 :], walls))) for row, box in enumerate(whole)]
        boxes_xyxy = np.array([_seen_box(box, cells) for box, cells in zip(whole, seen, strict=True)])
        return View(shapes, boxes_xyxy.astype(np.float32), np.array([cells.mean() for cells in seen]))

    def image(self, view: View, background: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """An RGB image (H, W, 3) of `view` on a `background` of SIZE_HW; the walls look like that, too."""
        pixels = background.copy()
        for shape in view.shapes:
            shape.draw(pixels)
        for wall in self.walls_xyxy:
            left, top, right, bottom = (max(round(side), 0) for side in wall)
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


SCENES: Mapping[str, Callable[[np.random.Generator], TrackScene]] = MappingProxyType(
    {scene.__name__: scene for scene in (crossings, occlusions, returns, crowd)}
)


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
