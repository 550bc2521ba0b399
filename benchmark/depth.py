"""Errors of places in space in rendered depth scenes, and the cost.

PYTHONPATH=test python -m benchmark.depth [--scenes 40] [--seed 0]
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header
from support.depth_scene import CAMERA, LENSES, SHAPES, THIN, DepthScene, Difficulty, random_depth_scene
from support.floor_scene import random_floor_scene
from support.solids import KINDS

from benchmark.report import Figures, Program, Row, row, timed
from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.detection.masks import Masks
from yolov5_lifecycle.images.image import ColourImage
from yolov5_lifecycle.process.memory import prepare_heap
from yolov5_lifecycle.ros.messages import point_cloud_message
from yolov5_lifecycle.spatial.camera_model import Intrinsics
from yolov5_lifecycle.spatial.depth_image import DepthImage
from yolov5_lifecycle.spatial.placement import Box3D, Placement, place
from yolov5_lifecycle.spatial.points import SurfacePoints, surface_points
from yolov5_lifecycle.spatial.surface import surfaces_in

SCENES = {
    "sloped background": Difficulty(),
    "30 % holes": Difficulty(hole_share=0.3),
    "half occluded": Difficulty(hole_share=0.3, is_half_occluded=True),
    "half occluded, box as seen": Difficulty(0.3, is_half_occluded=True, is_box_of_visible=True),
    "on a floor": Difficulty(hole_share=0.3, stands_on_floor=True),
    "in a row": Difficulty(hole_share=0.3, has_neighbours=True),
}
FLOOR_SCENES: dict[str, dict[str, Any]] = {
    "ideal depth, exact boxes": {"is_ideal": True},
    "as measured": {},
    "as measured, others nearby": {"has_company": True},
    "ideal depth, between walls": {"is_ideal": True, "is_between_walls": True},
    "ideal depth, between walls, half hidden": {
        "is_ideal": True,
        "is_between_walls": True,
        "is_half_hidden": True,
    },
    "as measured, between walls, half hidden": {"is_between_walls": True, "is_half_hidden": True},
    **{f"ideal depth, {lens}": {"is_ideal": True, "camera": camera} for lens, camera in LENSES.items()},
}
KNOWN: dict[str, Callable[[DepthScene], Masks | None]] = {
    "box": lambda _: None,
    "mask": DepthScene.masks,
    "mask 2 pixels aside": lambda scene: scene.masks(aside_px=2),
    "mask in cells of 4 pixels": lambda scene: scene.masks(cell_px=4),
}
"""What is known of an object."""
GROUPS: dict[str, Callable[[DepthScene], bool]] = {
    "all": lambda _: True,
    "up to 1.5 m": lambda scene: scene.range_m <= 1.5,
    "1.5 to 3 m": lambda scene: 1.5 < scene.range_m <= 3,
    "3 to 7 m": lambda scene: scene.range_m > 3,
    "nothing hidden": lambda scene: scene.hidden_share == 0,
    "up to 30 % hidden": lambda scene: 0 < scene.hidden_share <= 0.3,
}
COSTS = ((1, (480, 640)), (20, (480, 640)), (20, (720, 1280)), (1000, (480, 640)), (1000, (12288, 16384)))
"""Boxes and image sizes."""

MIN_SIZE_M = 0.02
"""Errors of smaller sizes are in parts of this."""


def places(
    boxes_xyxy: NDArray[np.float32], depth: DepthImage, camera: Intrinsics, masks: Masks | None
) -> tuple[Placement, ...]:
    """Where this package finds the objects in the boxes (n, 4)."""
    return place(surfaces_in(boxes_xyxy, depth, camera, masks), camera)


def placed(scene: DepthScene, masks: Masks | None) -> Placement:
    depth = DepthImage(scene.depth_m, 1.0)
    (found,) = places(scene.box_xyxy[None], depth, scene.camera, masks)
    return found


def depth_error(scene: DepthScene, masks: Masks | None) -> float:
    """Of the middle of the object's surface, in percent; 100 for an object that is not found."""
    found, truth_m = placed(scene, masks), float(scene.centre_xyz_m[2])
    return 100 * abs(found.centre_xyz_m[2] - truth_m) / truth_m if isinstance(found, Box3D) else 100.0


def floor_errors(scene: DepthScene, masks: Masks | None) -> tuple[float, float]:
    """Errors of the centre, in percent of the range, and of the size along z, in percent of the true size."""
    found = placed(scene, masks)
    if not isinstance(found, Box3D):
        return 100.0, 100.0
    centre = np.linalg.norm(np.subtract(found.centre_xyz_m, scene.centre_xyz_m)) / scene.range_m
    true_m = max(float(scene.size_xyz_m[2]), MIN_SIZE_M)
    return 100 * float(centre), 100 * abs(found.size_xyz_m[2] - true_m) / true_m


def _rng(seed: int, *of_rows: str) -> np.random.Generator:
    """Own random numbers for each kind of scene, so that another kind changes no figure."""
    return np.random.default_rng([seed, *"".join(of_rows).encode()])


def error_rows(count: int, seed: int) -> Iterator[Row]:
    """Of the depth, in percent."""
    for kind in ("solid", "thin"):
        shapes = [shape for shape in SHAPES if (shape in THIN) == (kind == "thin")]
        for name, difficulty in SCENES.items():
            rng = _rng(seed, kind, name)
            scenes = [random_depth_scene(rng, shape, difficulty) for shape in shapes for _ in range(count)]
            for known, masks_of in KNOWN.items():
                errors = [depth_error(scene, masks_of(scene)) for scene in scenes]
                yield row(f"{kind}, {known}", name, 0, errors, unit="%")


def floor_rows(count: int, seed: int) -> Iterator[Row]:
    """Of the centre, in percent of the range, and of the size along z, in percent of the true one."""
    for name, options in FLOOR_SCENES.items():
        rng = _rng(seed, name)
        groups = {
            kind: [random_floor_scene(rng, kind, **options) for _ in range(3 * count)] for kind in KINDS
        }
        scenes = [scene for of_kind in groups.values() for scene in of_kind]
        groups |= {group: found for group, is_in in GROUPS.items() if (found := [*filter(is_in, scenes)])}
        for known, masks_of in KNOWN.items():
            for group, found in groups.items():
                errors = [floor_errors(scene, masks_of(scene)) for scene in found]
                centres, sizes = zip(*errors, strict=True)
                yield row(f"floor, {name}, {known}", f"{group}: centre", 0, centres, unit="%")
                yield row(f"floor, {name}, {known}", f"{group}: size along z", 0, sizes, unit="%")


def point_rows(count: int, seed: int) -> Iterator[Row]:
    """How many of the points are not on their object, and of its measured pixels have none, in percent."""
    options = FLOOR_SCENES["as measured, others nearby"]
    for kind in KINDS:
        rng = _rng(seed, "points", kind)
        scenes = [random_floor_scene(rng, kind, **options) for _ in range(count)]
        for known, masks_of in KNOWN.items():
            shares = [_point_shares(scene, masks_of(scene)) for scene in scenes]
            missing = [share for _, share in shares]
            beside = [share for share, _ in shares if not math.isnan(share)]  # where there are points
            yield row(f"points, {known}", f"{kind}: points beside it", 0, beside, unit="%")
            yield row(f"points, {known}", f"{kind}: pixels without a point", 0, missing, unit="%")


def _point_shares(scene: DepthScene, masks: Masks | None) -> tuple[float, float]:
    depth = DepthImage(scene.depth_m, 1.0)
    surfaces = surfaces_in(scene.box_xyxy[None], depth, scene.camera, masks)
    hits = points = 0
    for found in surface_points(surfaces, depth, scene.camera):
        points += len(found.rows)
        hits += scene.mask[found.rows, found.columns].sum()
    measured = (scene.mask & (scene.depth_m > 0)).sum()
    beside = 100 - 100 * hits / points if points else math.nan
    return beside, 100 - 100 * hits / measured


def point_cost_rows() -> Iterator[Row]:
    """CPU time for the points of 20 boards, one before the other, whose surfaces are found, and a message."""
    rng, (height, width), side = np.random.default_rng(0), (720, 1280), (60, 240)
    sizes = rng.uniform(*side, (20, 2))
    starts = rng.uniform(0, 1, (20, 2)) * ((width, height) - sizes)
    boxes_xyxy = np.hstack((starts, starts + sizes)).astype(np.float32)
    values = np.full((height, width), 8000, np.uint16)
    for depth_mm, (x1, y1, x2, y2) in zip(range(7000, 1000, -300), boxes_xyxy.astype(int), strict=True):
        values[y1:y2, x1:x2] = depth_mm
    depth, camera = DepthImage(values, 0.001), Intrinsics(900.0, 900.0, 640.0, 360.0, (height, width))
    surfaces = surfaces_in(boxes_xyxy, depth, camera)
    detections = Detections(boxes_xyxy, np.ones(20, np.float32), np.zeros(20, np.int64))
    image = ColourImage(rng.integers(0, 255, (height, width, 3), np.uint8), "bgr")
    for spacing_m in (0.05, 0.02, 0.0):
        find = partial(surface_points, surfaces, depth, camera, spacing_m=spacing_m)
        calls = {"": partial(_count, find), " and their message": partial(_message, find, detections, image)}
        for what, call in calls.items():
            times_ms = [1e3 * timed(call, time.process_time) for _ in range(20)]
            name = f"{_count(find):,} points of 20 objects, {spacing_m:g} m apart{what}"
            yield row("CPU time", name, 0, times_ms, unit="ms of a core")


def _count(find: Callable[[], Iterator[SurfacePoints]]) -> int:
    return sum(len(found.rows) for found in find())


def _message(
    find: Callable[[], Iterator[SurfacePoints]], detections: Detections, image: ColourImage
) -> PointCloud2:
    return point_cloud_message(find(), detections, image, Header())


def cost_rows() -> Iterator[Row]:
    """CPU time for all boxes of an image."""
    rng = np.random.default_rng(0)
    for count, (height, width) in COSTS:
        depth = DepthImage(rng.integers(500, 8000, (height, width)).astype(np.uint16), 0.001)
        camera = Intrinsics(CAMERA.fx, CAMERA.fy, width / 2, height / 2, (height, width))
        ends = np.sort(rng.uniform(0, 1, (count, 2, 2)), axis=1) * (width, height)
        boxes_xyxy = ends.reshape(count, 4).astype(np.float32)
        network = rng.normal(size=(32, 96, 160)).astype(np.float32), rng.normal(size=(count, 32))
        masks = Masks(network[0], network[1].astype(np.float32), (height, width))
        for known, given in (("", None), (" with masks", masks)):
            call = partial(places, boxes_xyxy, depth, camera, given)
            times_ms = [1e3 * timed(call, time.process_time) for _ in range(20)]
            name = f"{count} boxes{known}, {width}x{height}"
            yield row("CPU time", name, 0, times_ms, unit="ms of a core")


def measured(options: argparse.Namespace, _: Path) -> Figures:
    """Errors in all scenes, and the cost."""
    of_scenes = [
        found for rows in (error_rows, floor_rows, point_rows) for found in rows(options.scenes, options.seed)
    ]
    return [*of_scenes, *cost_rows(), *point_cost_rows()], []


PROGRAM = Program(
    "depth",
    __doc__,
    measured,
    {
        "--scenes": {"type": int, "default": 40, "help": "of each shape, a third of those of each solid"},
        "--seed": {"type": int, "default": 0, "help": "of the scenes; the constants were chosen with 100"},
    },
)
parser = PROGRAM.parser


if __name__ == "__main__":
    prepare_heap()  # as the node does: for its costs
    sys.exit(PROGRAM.main())
