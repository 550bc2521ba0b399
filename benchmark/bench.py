"""How long a forward and a detection take in each installed runtime, side by side.

python -m benchmark.bench [--weights FILE] [--size 1280x720] [--busy N] [--quick]
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path

import numpy as np

from yolov5_lifecycle.boxes import Selection
from yolov5_lifecycle.detector import Detector, load_detector
from yolov5_lifecycle.images import Picture
from yolov5_lifecycle.letterbox import Letterbox
from yolov5_lifecycle.model import Model
from yolov5_lifecycle.runtimes.loading import REQUIREMENTS, installed_runtimes
from yolov5_lifecycle.weights import load_weights

REPOSITORY = Path(__file__).parents[1]


@dataclass(frozen=True)
class Row:
    """Milliseconds of one thing under one load."""

    what: str
    runtime: str
    busy: int
    median_ms: float
    p10_ms: float
    p95_ms: float
    ratio: float
    """Median over the smallest median of the same thing under the same load."""


def main(arguments: Sequence[str] | None = None) -> int:
    options = _options(arguments)
    width, height = (int(side) for side in options.size.split("x"))
    model = load_weights(options.weights).model
    picture = Picture(np.random.default_rng(0).integers(0, 256, (height, width, 3), np.uint8), "bgr")
    rows: list[Row] = []
    for busy in sorted({0, options.busy}):
        with _busy_neighbours(busy):
            rows += _rows(model, picture, rounds=10 if options.quick else 60, busy=busy)
    _print_table(rows)
    _write_report(REPOSITORY / "build" / "bench" / "report.json", options, rows)
    return 0


def _options(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="bench", description=__doc__.partition("\n")[0] if __doc__ else "")
    embedded = REPOSITORY / "weights" / "shapes.safetensors"
    parser.add_argument("--weights", type=Path, default=embedded, help="default: %(default)s")
    parser.add_argument(
        "--size", default="1280x720", metavar="WxH", help="of the picture; default: %(default)s"
    )
    parser.add_argument(
        "--busy", type=int, default=1, metavar="N", help="busy neighbours; default: %(default)s"
    )
    parser.add_argument("--quick", action="store_true", help="fewer rounds")
    return parser.parse_args(arguments)


@contextmanager
def _busy_neighbours(number: int) -> Iterator[None]:
    """Processes that each keep one core busy."""
    neighbours = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(number)]
    try:
        yield
    finally:
        for neighbour in neighbours:
            neighbour.kill()
            neighbour.wait()


def _rows(model: Model, picture: Picture, *, rounds: int, busy: int) -> list[Row]:
    detectors = {name: load_detector(model, runtime=name, device="cpu") for name in installed_runtimes()}
    rows = []
    for what, calls in (
        ("forward", _forwards(detectors, picture)),
        ("detector", _detections(detectors, picture)),
    ):
        taken = _in_turns(calls, rounds)
        best = min(statistics.median(times) for times in taken.values())
        for name, times in taken.items():
            median = statistics.median(times)
            p10, p95 = np.percentile(times, (10, 95))
            rows.append(Row(what, name, busy, median, float(p10), float(p95), median / best))
    for detector in detectors.values():
        detector.close()
    return rows


def _forwards(detectors: dict[str, Detector], picture: Picture) -> dict[str, Callable[[], object]]:
    calls: dict[str, Callable[[], object]] = {}
    for name, detector in detectors.items():
        letterbox = Letterbox.fit(picture.size_hw, image_size=detector.image_size, stride=detector.stride)
        frame = letterbox.apply(picture.pixels)
        calls[name] = lambda run=detector.runtime, frame=frame: run(frame, picture.order)  # type: ignore[misc]
    return calls


def _detections(detectors: dict[str, Detector], picture: Picture) -> dict[str, Callable[[], object]]:
    return {
        name: lambda detector=detector: detector.detect(picture, Selection())  # type: ignore[misc]
        for name, detector in detectors.items()
    }


def _in_turns(calls: dict[str, Callable[[], object]], rounds: int) -> dict[str, list[float]]:
    """Milliseconds of every call, taken in turns after two that do not count."""
    taken: dict[str, list[float]] = {name: [] for name in calls}
    for turn in range(-2, rounds):
        for name, call in calls.items():
            before = time.perf_counter()
            call()
            if turn >= 0:
                taken[name].append(1e3 * (time.perf_counter() - before))
    return taken


def _print_table(rows: list[Row]) -> None:
    print(f"{'':10}{'runtime':14}{'busy':>4}{'median':>10}{'p10':>8}{'p95':>8}{'ratio':>7}   (ms)")
    for row in rows:
        print(
            f"{row.what:10}{row.runtime:14}{row.busy:4}{row.median_ms:10.1f}{row.p10_ms:8.1f}{row.p95_ms:8.1f}"
            f"{row.ratio:7.2f}"
        )


def _write_report(path: Path, options: argparse.Namespace, rows: list[Row]) -> None:
    packages = sorted({package for name in installed_runtimes() for package in REQUIREMENTS[name]})
    report = {
        "options": {name: str(value) for name, value in vars(options).items()},
        "versions": {package: version(package) for package in packages},
        "machine": {"cores": os.cpu_count(), "system": platform.platform(), "load": os.getloadavg()},
        "rows": [asdict(row) for row in rows],
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(report, indent=2) + "\n", encoding="utf-8")
    print(f"\n{path}")


if __name__ == "__main__":
    sys.exit(main())
