"""What collecting images costs a detector, and whether it delays detections.

python -m benchmark.collecting [--rounds 5] [--seconds 10] [--rate 30]
"""

from __future__ import annotations

import argparse
import statistics
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from benchmark.camera_fleet import Passage, active_fleet
from benchmark.materials import materials
from benchmark.report import Goal, Row, goal_table, row, table, write_report

REPORT = Path(__file__).parents[1] / "build" / "bench" / "collecting.json"
IMAGE_HW = (720, 1280)
CAMERA = "front"
OFF, NOTHING_KEPT, ONE_A_SECOND = "off", "on, nothing kept", "on, one image kept a second"
_KEEPING: dict[str, dict[str, object]] = {
    OFF: {},
    # The camera sends one image again and again: all after the first are near duplicates.
    NOTHING_KEPT: {"collect": True, "collect_per_minute": 0.0},
    ONE_A_SECOND: {"collect": True, "collect_per_minute": 0.0},
}


def figures(passages: dict[str, list[Passage]]) -> tuple[list[Row], list[Goal]]:
    """Latency and processor time of each way of collecting, and what it adds to those without."""
    rows, goals = [], []
    for name, passed in passages.items():
        latencies = [latency for passage in passed for latency in passage.latencies_ms]
        rows.append(row("latency", name, 0, latencies))
        rows.append(row("CPU", name, 0, [_cpu_percent(passage) for passage in passed], unit="% of a core"))
    for name, most in ((NOTHING_KEPT, 2.0), (ONE_A_SECOND, 10.0)):
        pairs = list(zip(passages[name], passages[OFF], strict=True))
        added = statistics.median(_cpu_percent(on) - _cpu_percent(off) for on, off in pairs)
        ratio = statistics.median(_latency_ms(on) / _latency_ms(off) for on, off in pairs)
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


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, print and write the report; returns 0."""
    options = parser().parse_args(arguments)
    passages: dict[str, list[Passage]] = {name: [] for name in _KEEPING}
    with tempfile.TemporaryDirectory(prefix="bench-") as name:
        folder = Path(name)
        weights, image = materials(IMAGE_HW, folder)
        passage(OFF, weights, image, folder, options)  # the runtime is chosen, and cached
        for number in range(options.rounds):
            for way in list(_KEEPING)[:: 1 if number % 2 == 0 else -1]:
                passages[way].append(passage(way, weights, image, folder, options))
    rows, goals = figures(passages)
    sys.stdout.write(f"{table(rows)}\n\n{goal_table(goals)}\n")
    write_report(REPORT, vars(options), rows, goals)
    return 0


def parser() -> argparse.ArgumentParser:
    """The argument parser."""
    parser = argparse.ArgumentParser(
        prog="benchmark.collecting", description=(__doc__ or "").partition("\n")[0]
    )
    parser.add_argument("--rounds", type=int, default=5, metavar="N", help="default: %(default)s")
    parser.add_argument("--seconds", type=float, default=10.0, metavar="S", help="default: %(default)g")
    parser.add_argument("--rate", type=float, default=30.0, metavar="HZ", help="default: %(default)g")
    return parser


def _cpu_percent(passage: Passage) -> float:
    return 100 * passage.cpu_s / passage.duration_s


def _latency_ms(passage: Passage) -> float:
    return statistics.median(passage.latencies_ms)


if __name__ == "__main__":
    sys.exit(main())
