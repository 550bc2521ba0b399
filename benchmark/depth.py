"""Errors of places in space in rendered depth scenes, compared with simpler statistics, and the cost.

PYTHONPATH=test python -m benchmark.depth [--scenes 40] [--seed 0]
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from support.depth_scene import CAMERA, SHAPES, THIN, DepthScene, Difficulty, random_depth_scene
from support.floor_scene import random_floor_scene
from support.solids import KINDS

from benchmark.report import Figures, Program, Row, row, timed
from yolov5_lifecycle.spatial.box_samples import inside, sampled
from yolov5_lifecycle.spatial.depth_image import DepthImage, Intrinsics
from yolov5_lifecycle.spatial.placement import Box3D, Placement, place

SCENES = {
    "sloped background": Difficulty(),
    "30 % holes": Difficulty(hole_share=0.3),
    "half occluded": Difficulty(hole_share=0.3, is_half_occluded=True),
}
FLOOR_SCENES = {
    "ideal depth, exact boxes": {"is_ideal": True},
    "as measured": {},
    "as measured, others nearby": {"has_company": True},
}
COSTS = ((1, (480, 640)), (20, (480, 640)), (20, (720, 1280)), (1000, (480, 640)), (1000, (12288, 16384)))
"""Boxes and image sizes."""

MIN_SIZE_M = 0.02
"""Errors of smaller sizes are in parts of this."""

Estimate = Callable[[NDArray[np.float32]], float]
"""Depth in metres from the measurements in a box."""


def nearest_mode_m(metres: NDArray[np.float32]) -> float:
    """The nearest depth that a tenth of the measurements share within 2.5 %."""
    logarithms = np.sort(np.log(metres))
    ends = np.searchsorted(logarithms, logarithms + 0.025)
    enough = ends - np.arange(len(metres)) >= 0.1 * len(metres)
    first = int(enough.argmax())
    return float(np.exp(np.median(logarithms[first : ends[first]])))


RIVALS: dict[str, Estimate] = {
    "mean": lambda metres: float(metres.mean()),
    "median": lambda metres: float(np.median(metres)),
    "fifth nearest of 100": lambda metres: float(np.quantile(metres, 0.05)),
    "nearest mode": nearest_mode_m,
}


def placed(scene: DepthScene) -> Placement:
    """Where this package finds the object."""
    (found,) = place(scene.box_xyxy[None], CAMERA.size_hw, DepthImage(scene.depth_m, 1.0), CAMERA)
    return found


def depths_m(scene: DepthScene) -> dict[str, float]:
    """The depth of the object in the middle of its surface, by every method; NaN where one finds none."""
    samples = inside(sampled(DepthImage(scene.depth_m, 1.0), scene.box_xyxy[None]).metres)
    measured = samples[~np.isnan(samples)]
    rivals = {name: estimate(measured) if measured.size else np.nan for name, estimate in RIVALS.items()}
    found = placed(scene)
    return {"this": found.centre_xyz_m[2] if isinstance(found, Box3D) else np.nan, **rivals}


def errors(scenes: Sequence[DepthScene]) -> dict[str, list[float]]:
    """For every method the errors of the depth in percent; 100 for an object that is not found."""
    found: dict[str, list[float]] = {}
    for scene in scenes:
        truth_m = float(scene.centre_xyz_m[2])
        for name, depth_m in depths_m(scene).items():
            error = 100 * abs(depth_m - truth_m) / truth_m
            found.setdefault(name, []).append(error if np.isfinite(error) else 100.0)
    return found


def floor_errors(scene: DepthScene) -> tuple[float, float]:
    """Errors of the centre, in percent of the range, and of the size along z, in percent of the true size."""
    found = placed(scene)
    if not isinstance(found, Box3D):
        return 100.0, 100.0
    centre = np.linalg.norm(np.subtract(found.centre_xyz_m, scene.centre_xyz_m)) / scene.range_m
    true_m = max(float(scene.size_xyz_m[2]), MIN_SIZE_M)
    return 100 * float(centre), 100 * abs(found.size_xyz_m[2] - true_m) / true_m


def error_rows(count: int, seed: int) -> Iterator[Row]:
    """Of the depth, in percent, for each method."""
    rng = np.random.default_rng(seed)
    for kind in ("solid", "thin"):
        shapes = [shape for shape in SHAPES if (shape in THIN) == (kind == "thin")]
        for name, difficulty in SCENES.items():
            scenes = [random_depth_scene(rng, shape, difficulty) for shape in shapes for _ in range(count)]
            for method, found in errors(scenes).items():
                yield row(f"{kind}, {name}", method, 0, found, unit="%")


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
