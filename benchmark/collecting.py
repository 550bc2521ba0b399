"""What collecting images costs a detector, and whether it delays detections.

python -m benchmark.collecting [--rounds 5] [--seconds 10] [--rate 30]
"""

from __future__ import annotations

import argparse
import statistics
import sys
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path

from benchmark.camera_fleet import Passage, active_fleet, materials
from benchmark.report import Figures, Goal, Program, in_turns, median_ratio, row

IMAGE_HW = (720, 1280)
CAMERA = "front"
OFF, NOTHING_KEPT, ONE_A_SECOND = "off", "on, nothing kept", "on, one image kept a second"
_KEEPING: dict[str, dict[str, object]] = {
    OFF: {},
    # The camera sends one image again and again: all after the first are near duplicates.
    NOTHING_KEPT: {"collect": True, "collect_per_minute": 0.0},
    ONE_A_SECOND: {"collect": True, "collect_per_minute": 0.0},
}


def figures(passages: Mapping[str, Sequence[Passage]]) -> Figures:
    """Latency and processor time of each way of collecting, and what it adds to those without."""
    rows, goals = [], []
    for name, passed in passages.items():
        latencies = [latency for passage in passed for latency in passage.latencies_ms]
        rows.append(row("latency", name, 0, latencies))
        rows.append(row("CPU", name, 0, [passage.cpu_percent for passage in passed], unit="% of a core"))
    for name, most in ((NOTHING_KEPT, 2.0), (ONE_A_SECOND, 10.0)):
        pairs = zip(passages[name], passages[OFF], strict=True)
        added = statistics.median(on.cpu_percent - off.cpu_percent for on, off in pairs)
        ratio = median_ratio(map(_latency_ms, passages[name]), map(_latency_ms, passages[OFF]))
        goals += [
            Goal(f"{name}: processor added, % of a core", 0, added, True, most),
            Goal(f"{name}: latency / without", 0, ratio, True, 1.02),
        ]
    return rows, goals


def passage(name: str, weights: Path, image: Path, folder: Path, options: argparse.Namespace) -> Passage:
    """One measurement in new processes."""
    collected = folder / "collected"
    given: dict[str, object] = {"collect_dir": collected, "collect_min_free_mb": 0} | _KEEPING[name]
    with (
        active_fleet("a node each", [CAMERA], weights=weights, cache=folder, **given) as fleet,
        fleet.camera(CAMERA, image, rate_hz=options.rate),
    ):
        fleet.wait_for([CAMERA])
        if name == ONE_A_SECOND:
            fleet.collect_every(1.0)
        return fleet.watch([CAMERA], options.seconds)


def measured(options: argparse.Namespace, folder: Path) -> Figures:
    """Each way in each round."""
    weights, image = materials(IMAGE_HW, folder)
    passage(OFF, weights, image, folder, options)  # the runtime is chosen, and cached
    calls = {way: partial(passage, way, weights, image, folder, options) for way in _KEEPING}
    return figures(in_turns(calls, options.rounds, mirrored=True))


def _latency_ms(passage: Passage) -> float:
    return statistics.median(passage.latencies_ms)


PROGRAM = Program(
    "collecting",
    __doc__,
    measured,
    {
        "--rounds": {"type": int, "default": 5, "help": "of all ways"},
        "--seconds": {"type": float, "default": 10.0, "help": "of each passage"},
        "--rate": {"type": float, "default": 30.0, "help": "of the camera, in Hz"},
    },
)
parser = PROGRAM.parser


if __name__ == "__main__":
    sys.exit(PROGRAM.main())
