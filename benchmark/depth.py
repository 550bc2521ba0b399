"""Errors of places in space in rendered depth scenes, and the cost.

PYTHONPATH=test python -m benchmark.depth [--scenes 40] [--seed 0]
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from support.depth_scene import CAMERA, LENSES, SHAPES, THIN, DepthScene, Difficulty, random_depth_scene
from support.floor_scene import random_floor_scene
from support.solids import KINDS

from benchmark.report import Figures, Program, Row, row, timed
from yolov5_lifecycle.spatial.camera_model import Intrinsics
from yolov5_lifecycle.spatial.depth_image import DepthImage
from yolov5_lifecycle.spatial.placement import Box3D, Placement, place

SCENES = {
    "sloped background": Difficulty(),
    "30 % holes": Difficulty(hole_share=0.3),
    "half occluded": Difficulty(hole_share=0.3, is_half_occluded=True),
    "on a floor": Difficulty(hole_share=0.3, stands_on_floor=True),
    "in a row": Difficulty(hole_share=0.3, has_neighbours=True),
}
FLOOR_SCENES: dict[str, dict[str, Any]] = {
    "ideal depth, exact boxes": {"is_ideal": True},
    "as measured": {},
    "as measured, others nearby": {"has_company": True},
    **{f"ideal depth, {lens}": {"is_ideal": True, "camera": camera} for lens, camera in LENSES.items()},
}
COSTS = ((1, (480, 640)), (20, (480, 640)), (20, (720, 1280)), (1000, (480, 640)), (1000, (12288, 16384)))
"""Boxes and image sizes."""

MIN_SIZE_M = 0.02
"""Errors of smaller sizes are in parts of this."""


def placed(scene: DepthScene) -> Placement:
    """Where this package finds the object."""
    (found,) = place(scene.box_xyxy[None], CAMERA.size_hw, DepthImage(scene.depth_m, 1.0), scene.camera)
    return found


def depth_error(scene: DepthScene) -> float:
    """Of the middle of the object's surface, in percent; 100 for an object that is not found."""
    found, truth_m = placed(scene), float(scene.centre_xyz_m[2])
    return 100 * abs(found.centre_xyz_m[2] - truth_m) / truth_m if isinstance(found, Box3D) else 100.0


def floor_errors(scene: DepthScene) -> tuple[float, float]:
    """Errors of the centre, in percent of the range, and of the size along z, in percent of the true size."""
    found = placed(scene)
    if not isinstance(found, Box3D):
        return 100.0, 100.0
    centre = np.linalg.norm(np.subtract(found.centre_xyz_m, scene.centre_xyz_m)) / scene.range_m
    true_m = max(float(scene.size_xyz_m[2]), MIN_SIZE_M)
    return 100 * float(centre), 100 * abs(found.size_xyz_m[2] - true_m) / true_m


def error_rows(count: int, seed: int) -> Iterator[Row]:
    """Of the depth, in percent."""
    rng = np.random.default_rng(seed)
    for kind in ("solid", "thin"):
        shapes = [shape for shape in SHAPES if (shape in THIN) == (kind == "thin")]
        for name, difficulty in SCENES.items():
            scenes = [random_depth_scene(rng, shape, difficulty) for shape in shapes for _ in range(count)]
            yield row(kind, name, 0, [depth_error(scene) for scene in scenes], unit="%")


def floor_rows(count: int, seed: int) -> Iterator[Row]:
    """Of the centre, in percent of the range, and of the size along z, in percent of the true one."""
    rng = np.random.default_rng(seed)
    for name, options in FLOOR_SCENES.items():
        of_kinds: dict[str, list[tuple[float, float]]] = {
            kind: [floor_errors(random_floor_scene(rng, kind, **options)) for _ in range(3 * count)]
            for kind in KINDS
        }
        of_kinds["all"] = [both for found in of_kinds.values() for both in found]
        for kind, found in of_kinds.items():
            centres, sizes = zip(*found, strict=True)
            yield row(f"floor, {name}", f"{kind}: centre", 0, centres, unit="%")
            yield row(f"floor, {name}", f"{kind}: size along z", 0, sizes, unit="%")


def cost_rows() -> Iterator[Row]:
    """CPU time for all boxes of an image."""
    rng = np.random.default_rng(0)
    for count, (height, width) in COSTS:
        depth = DepthImage(rng.integers(500, 8000, (height, width)).astype(np.uint16), 0.001)
        camera = Intrinsics(CAMERA.fx, CAMERA.fy, width / 2, height / 2, (height, width))
        ends = np.sort(rng.uniform(0, 1, (count, 2, 2)), axis=1) * (width, height)
        call = partial(place, ends.reshape(count, 4).astype(np.float32), (height, width), depth, camera)
        times_ms = [1e3 * timed(call, time.process_time) for _ in range(20)]
        yield row("CPU time", f"{count} boxes, {width}x{height}", 0, times_ms, unit="ms of a core")


def measured(options: argparse.Namespace, _: Path) -> Figures:
    """Errors in all scenes, and the cost."""
    of_scenes = [*error_rows(options.scenes, options.seed), *floor_rows(options.scenes, options.seed)]
    return [*of_scenes, *cost_rows()], []


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
    sys.exit(PROGRAM.main())
