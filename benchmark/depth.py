"""Distance errors in rendered depth scenes compared with simpler statistics, and the cost of each.

PYTHONPATH=test python -m benchmark.depth [--scenes 40]
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray
from support.depth_scene import CAMERA, SHAPES, THIN, DepthScene, Difficulty, random_depth_scene

from yolov5_lifecycle.spatial.depth_image import DepthImage
from yolov5_lifecycle.spatial.intrinsics import Intrinsics
from yolov5_lifecycle.spatial.placement import place
from yolov5_lifecycle.spatial.surface import sampled, surface_extents_m

SCENES = {
    "sloped background": Difficulty(),
    "30 % holes": Difficulty(hole_share=0.3),
    "half occluded": Difficulty(hole_share=0.3, is_half_occluded=True),
    "on a floor": Difficulty(hole_share=0.3, stands_on_floor=True),
    "in a row": Difficulty(hole_share=0.3, has_neighbours=True),
}
COSTS = ((1, (480, 640)), (20, (480, 640)), (1000, (480, 640)), (1000, (12288, 16384)))
"""Boxes and image sizes."""

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


def depths_m(scene: DepthScene) -> dict[str, float]:
    """The depth of the object in the middle of its surface, by every method; NaN where one finds none."""
    samples = sampled(DepthImage(scene.depth_m, 1.0), scene.box_xyxy[None])
    measured = samples.inside[~np.isnan(samples.inside)]
    rivals = {name: estimate(measured) if measured.size else np.nan for name, estimate in RIVALS.items()}
    return {"more than around the box": float(surface_extents_m(samples).mean()), **rivals}


def errors(scenes: Sequence[DepthScene]) -> dict[str, list[float]]:
    """For every method the errors of the depth in percent; 100 for an object that is not found."""
    found: dict[str, list[float]] = {}
    for scene in scenes:
        truth_m = float(scene.centre_xyz_m[2])
        for name, depth_m in depths_m(scene).items():
            error = 100 * abs(depth_m - truth_m) / truth_m
            found.setdefault(name, []).append(error if np.isfinite(error) else 100.0)
    return found


def print_errors(count: int) -> None:
    rng = np.random.default_rng(0)
    print("Error of the depth, in percent: median / 95th percentile\n")
    for kind in ("solid", "thin"):
        shapes = [shape for shape in SHAPES if (shape in THIN) == (kind == "thin")]
        for name, difficulty in SCENES.items():
            scenes = [random_depth_scene(rng, shape, difficulty) for shape in shapes for _ in range(count)]
            cells = [
                f"{method} {statistics.median(found):.1f} / {np.quantile(found, 0.95):.1f}"
                for method, found in errors(scenes).items()
            ]
            print(f"{kind}, {name}: " + ", ".join(cells))


def print_costs() -> None:
    rng = np.random.default_rng(0)
    print("\nCPU time for all boxes of an image, in milliseconds\n")
    for count, (height, width) in COSTS:
        depth = DepthImage(rng.integers(500, 8000, (height, width)).astype(np.uint16), 0.001)
        camera = Intrinsics(CAMERA.fx, CAMERA.fy, width / 2, height / 2, (height, width))
        ends = np.sort(rng.uniform(0, 1, (count, 2, 2)), axis=1) * (width, height)
        boxes_xyxy = ends.reshape(count, 4).astype(np.float32)
        times_ms = []
        for _ in range(20):
            begin = time.process_time()
            place(boxes_xyxy, (height, width), depth, camera)
            times_ms.append(1000 * (time.process_time() - begin))
        print(f"{count} boxes, {width}x{height}: {statistics.median(times_ms):.2f}")


def parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--scenes", type=int, default=40, help="scenes of each shape and difficulty (default 40)"
    )
    return parser


def main() -> None:
    print_errors(parser().parse_args().scenes)
    print_costs()


if __name__ == "__main__":
    main()
