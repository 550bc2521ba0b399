"""Time of every stage and of alternatives, on a quiet machine and next to busy processes.

python -m benchmark.bench [--weights FILE] [--size 1280x720] [--busy N] [--quick]
"""

from __future__ import annotations

import argparse
import gc
import statistics
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

from benchmark.models import untrained_weights
from benchmark.neighbours import busy_neighbours
from benchmark.node import MeasuredDetector, detector_node, image_file
from benchmark.report import STAGE, Goal, Row, goal_table, row, table, write_report
from benchmark.rivals import RIVALS
from benchmark.rounds import measure
from benchmark.task import Task
from benchmark.work import RUNTIME_PREFIX
from yolov5_lifecycle.checkpoints.locate import load_weights
from yolov5_lifecycle.runtimes.registry import installed_runtimes

REPORT = Path(__file__).parents[1] / "build" / "bench" / "report.json"
SIZES_WH = ("640x480", "1280x720", "1920x1080")
_AUTO = f"{RUNTIME_PREFIX}auto"
_USUAL = "eager torch"
_BEST_RIVALS = ("ONNX Runtime", "ONNX Runtime, no spinning", "OpenVINO")
_STAGES = ("letterbox", "selection", "crowded selection", "detector")
_SLOW_HZ = 10.0
_USUAL_HZ = 30.0
_FLOOD = 1.25  # times the maximum rate of the forward pass alone
_IDLE_S = 5.0


class Bench:
    """One run: measurements are collected in `rows`, comparisons in `goals`."""

    def __init__(self, weights: Path, size: str, loads: Sequence[int], *, quick: bool, folder: Path) -> None:
        self.rows: list[Row] = []
        self.goals: list[Goal] = []
        self._weights = weights
        self._size = size
        self._loads = loads
        self._quick = quick
        self._folder = folder
        self._medians_ms: dict[tuple[str, int], float] = {}

    def forwards(self) -> None:
        """Every runtime, every rival and every stage of the detector."""
        runtimes = [f"{RUNTIME_PREFIX}{name}" for name in (*installed_runtimes(), "auto")]
        tasks = [
            *(Task("rivals", name, str(self._weights), _hw(self._size)) for name in RIVALS),
            *(Task("work", name, str(self._weights), _hw(self._size)) for name in (*runtimes, *_STAGES)),
        ]
        turns = 4 if self._quick else 25
        taken_ms, peaks_mb = measure(tasks, loads=self._loads, turns=turns, cache=self._folder)
        for (task, busy), times_ms in taken_ms.items():
            what = STAGE if task.name in _STAGES else "forward"
            self._add(row(what, task.name, busy, times_ms))
        for task, peak_mb in peaks_mb.items():
            self._add(row("memory", task.name, self._loads[-1], [peak_mb], unit="MB at most"))
        for busy in self._loads:
            medians_ms = {name: median for (name, load), median in self._medians_ms.items() if load == busy}
            self.goals += forward_goals(medians_ms, busy)

    def model_sizes(self) -> None:
        """The forward of larger networks."""
        for size in () if self._quick else ("s", "m"):
            weights = str(untrained_weights(size, self._folder))
            names = [f"{RUNTIME_PREFIX}{name}" for name in installed_runtimes()]
            tasks = [Task("work", name, weights, _hw(self._size)) for name in names]
            taken_ms, _ = measure(tasks, loads=self._loads, turns=4, cache=self._folder)
            for (task, busy), times_ms in taken_ms.items():
                self._add(row(f"size {size}", task.name, busy, times_ms))

    def node(self) -> None:
        """Processes as on a robot, images of several sizes."""
        with detector_node(self._weights, self._folder / "node") as node:
            load_s = _load_s(self._weights)
            self._add(row("node", "activate, first time", 0, [node.activate_s()], unit="s"))
            node.deactivate()
            again_s = node.activate_s()
            self._add(row("node", "activate again", 0, [again_s], unit="s"))
            self.goals.append(Goal("activate again - load [s]", 0, again_s - load_s, True, 1.0))
            for busy in self._loads:
                with busy_neighbours(busy):
                    for size in (self._size,) if self._quick else SIZES_WH:
                        self._passage(node, size, busy)
                    self._saturation(node, busy)
            self._rate_limit(node)
            self._idle(node)
            self._add(row("node", "memory", 0, [node.peak_resident_mb], unit="MB at most"))

    def _add(self, new: Row) -> None:
        self.rows.append(new)
        if new.unit == "ms":
            self._medians_ms[new.name, new.busy] = new.median

    def _passage(self, node: MeasuredDetector, size: str, busy: int) -> None:
        image = image_file(_hw(size), self._folder)
        for rate_hz in (_SLOW_HZ, _USUAL_HZ):
            passage = node.watch(image, rate_hz=rate_hz, frames=20 if self._quick else 100)
            what = f"{size} at {rate_hz:g} Hz"
            self._add(row("node", f"latency {what}", busy, passage.latencies_ms))
            self._add(
                row("node", f"CPU a frame {what}", busy, [passage.cpu_ms_per_frame], unit="ms of a core")
            )
            if (size, rate_hz) == (self._size, self._followed_hz(busy)):
                ratio = statistics.median(passage.latencies_ms) / self._medians_ms["detector", busy]
                self.goals.append(Goal(f"node latency at {rate_hz:g} Hz / detector", busy, ratio, True, 1.35))

    def _followed_hz(self, busy: int) -> float:
        """The usual camera rate if the detector can keep up with it, else the slow one."""
        return _USUAL_HZ if self._medians_ms["detector", busy] < 1e3 / _USUAL_HZ else _SLOW_HZ

    def _saturation(self, node: MeasuredDetector, busy: int) -> None:
        image = image_file(_hw(self._size), self._folder)
        rate_hz = _FLOOD * 1e3 / self._medians_ms[_AUTO, busy]
        passage = node.watch(image, rate_hz=rate_hz, frames=40 if self._quick else 200)
        self._add(row("node", "throughput", busy, [passage.rate_hz], unit="Hz"))
        self._add(row("node", "latency when flooded", busy, passage.latencies_ms))
        share = passage.rate_hz * self._medians_ms[_AUTO, busy] / 1e3
        self.goals.append(Goal("throughput * forward", busy, share, False, 0.90))

    def _rate_limit(self, node: MeasuredDetector) -> None:
        image = image_file((480, 640), self._folder)
        node.set_parameters(max_rate=_SLOW_HZ)
        passage = node.watch(image, rate_hz=_USUAL_HZ, frames=40 if self._quick else 100)
        node.set_parameters(max_rate=0.0)
        deviation = abs(passage.rate_hz / _SLOW_HZ - 1)
        self._add(
            row("node", f"max_rate {_SLOW_HZ:g}, camera {_USUAL_HZ:g} Hz", 0, [passage.rate_hz], unit="Hz")
        )
        self.goals.append(Goal("deviation from max_rate [%]", 0, 100 * deviation, True, 2.0))

    def _idle(self, node: MeasuredDetector) -> None:
        image = image_file((480, 640), self._folder)
        share = node.idle_cpu_share(image, rate_hz=30.0, duration_s=_IDLE_S)
        self._add(row("node", "nobody listens", 0, [100 * share], unit="% of a core"))
        self.goals.append(Goal("nobody listens [% of a core]", 0, 100 * share, True, 2.0))


def forward_goals(medians_ms: Mapping[str, float], busy: int) -> list[Goal]:
    """Goals for the medians of forward passes and stages, by name, next to `busy` processes."""
    auto_ms = medians_ms[_AUTO]
    rival_ms = min(medians_ms[name] for name in _BEST_RIVALS if name in medians_ms)
    return [
        Goal("forward / best bare rival", busy, auto_ms / rival_ms, True, 1.10),
        Goal(f"{_USUAL} / forward", busy, medians_ms[_USUAL] / auto_ms, False, 4.0 if busy else 2.2),
        Goal("detector / forward", busy, medians_ms["detector"] / auto_ms, True, 1.20),
    ]


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, print and write the report; returns 0."""
    options = parser().parse_args(arguments)
    gc.disable()  # a full collection would stop the detection subscriber for 0.2 s
    with tempfile.TemporaryDirectory(prefix="bench-") as folder:
        bench = Bench(
            options.weights or untrained_weights("n", Path(folder)),
            options.size,
            sorted({0, options.busy}),
            quick=options.quick,
            folder=Path(folder),
        )
        for part in (bench.forwards, bench.model_sizes, bench.node):
            _say(f"measuring: {part.__doc__}")
            part()
    _say(f"\n{table(bench.rows)}\n\n{goal_table(bench.goals)}")
    write_report(REPORT, vars(options), bench.rows, bench.goals)
    _say(f"\n{REPORT}")
    return 0


def parser() -> argparse.ArgumentParser:
    """The argument parser."""
    parser = argparse.ArgumentParser(prog="bench", description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--weights", type=Path, help="default: an untrained yolov5n")
    parser.add_argument("--size", default="1280x720", choices=SIZES_WH, help="default: %(default)s")
    parser.add_argument(
        "--busy", type=int, default=1, metavar="N", help="number of busy processes; default: %(default)s"
    )
    parser.add_argument("--quick", action="store_true", help="fewer rounds, one size")
    return parser


def _hw(size: str) -> tuple[int, int]:
    width, height = map(int, size.split("x"))
    return height, width


def _load_s(weights: Path) -> float:
    begun_s = time.monotonic()
    load_weights(weights)
    return time.monotonic() - begun_s


def _say(text: str) -> None:
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main())
