"""Time of every stage and of alternatives, on a quiet machine and next to busy processes.

python -m benchmark.bench [--weights FILE] [--size 1280x720] [--busy N] [--quick]
"""

from __future__ import annotations

import argparse
import gc
import statistics
import sys
from collections.abc import Mapping
from functools import partial
from pathlib import Path

from benchmark.camera_fleet import Fleet, Passage, active_fleet
from benchmark.contender import Task, busy_processes, measure
from benchmark.models import untrained_weights
from benchmark.report import STAGE, Figures, Goal, Program, Row, quick, row, size_hw, timed
from benchmark.rivals import RIVALS
from benchmark.work import RUNTIME_PREFIX, image_file
from yolov5_lifecycle.checkpoints.locate import load_weights
from yolov5_lifecycle.runtimes.registry import installed_runtimes

SIZES_WH = ("640x480", "1280x720", "1920x1080")
_AUTO = f"{RUNTIME_PREFIX}auto"
_USUAL = "eager torch"
_BEST_RIVALS = ("ONNX Runtime", "ONNX Runtime, no spinning", "OpenVINO")
_STAGES = ("letterbox", "selection", "crowded selection", "detector")
_SLOW_HZ = 10.0
_USUAL_HZ = 30.0
_FLOOD = 1.25  # times the maximum rate of the forward pass alone
_IDLE_S = 5.0
_NODE = "yolov5"


class Bench:
    """One run: measurements are collected in `rows`, comparisons in `goals`."""

    def __init__(self, options: argparse.Namespace, folder: Path) -> None:
        self.rows: list[Row] = []
        self.goals: list[Goal] = []
        self._weights = options.weights or untrained_weights("n", folder)
        self._size = options.size
        self._loads = sorted({0, options.busy})
        self._quick = options.quick
        self._folder = folder
        self._medians_ms: dict[tuple[str, int], float] = {}

    def forwards(self) -> None:
        """Every runtime, every rival and every stage of the detector."""
        runtimes = [f"{RUNTIME_PREFIX}{name}" for name in (*installed_runtimes(), "auto")]
        tasks = [
            *(Task("rivals", name, str(self._weights), size_hw(self._size)) for name in RIVALS),
            *(Task("work", name, str(self._weights), size_hw(self._size)) for name in (*runtimes, *_STAGES)),
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

    def node(self) -> None:
        """Processes as on a robot, images of several sizes."""
        load_s = timed(partial(load_weights, self._weights))
        cache = self._folder / "node"
        with active_fleet("a node each", [_NODE], weights=self._weights, cache=cache) as fleet:
            self._add(row("node", "activate, first time", 0, [fleet.activation_s], unit="s"))
            fleet.change("deactivate")
            again_s = fleet.change("activate")
            self._add(row("node", "activate again", 0, [again_s], unit="s"))
            self.goals.append(Goal("activate again - load [s]", 0, again_s - load_s, True, 1.0))
            for busy in self._loads:
                with busy_processes(busy):
                    for size in (self._size,) if self._quick else SIZES_WH:
                        self._passage(fleet, size, busy)
                    self._saturation(fleet, busy)
            self._rate_limit(fleet)
            self._idle(fleet)
            self._add(row("node", "memory", 0, [fleet.peak_resident_mb], unit="MB at most"))

    def _add(self, new: Row) -> None:
        self.rows.append(new)
        if new.unit == "ms":
            self._medians_ms[new.name, new.busy] = new.median

    def _watched(self, fleet: Fleet, size: str, rate_hz: float, frames: int) -> Passage:
        """Until `frames` images are detected."""
        with fleet.camera(_NODE, image_file(size_hw(size), self._folder), rate_hz=rate_hz):
            fleet.wait_for([_NODE])
            return fleet.watch([_NODE], frames=frames)

    def _passage(self, fleet: Fleet, size: str, busy: int) -> None:
        for rate_hz in (_SLOW_HZ, _USUAL_HZ):
            passage = self._watched(fleet, size, rate_hz, 20 if self._quick else 100)
            what = f"{size} at {rate_hz:g} Hz"
            self._add(row("node", f"latency {what}", busy, passage.latencies_ms))
            self._add(row("node", f"CPU a frame {what}", busy, [passage.cpu_ms], unit="ms of a core"))
            if (size, rate_hz) == (self._size, self._followed_hz(busy)):
                ratio = statistics.median(passage.latencies_ms) / self._medians_ms["detector", busy]
                self.goals.append(Goal(f"node latency at {rate_hz:g} Hz / detector", busy, ratio, True, 1.35))

    def _followed_hz(self, busy: int) -> float:
        """The usual camera rate if the detector can keep up with it, else the slow one."""
        return _USUAL_HZ if self._medians_ms["detector", busy] < 1e3 / _USUAL_HZ else _SLOW_HZ

    def _saturation(self, fleet: Fleet, busy: int) -> None:
        rate_hz = _FLOOD * 1e3 / self._medians_ms[_AUTO, busy]
        passage = self._watched(fleet, self._size, rate_hz, 40 if self._quick else 200)
        self._add(row("node", "throughput", busy, [passage.stamped_hz], unit="Hz"))
        self._add(row("node", "latency when flooded", busy, passage.latencies_ms))
        share = passage.stamped_hz * self._medians_ms[_AUTO, busy] / 1e3
        self.goals.append(Goal("throughput * forward", busy, share, False, 0.90))

    def _rate_limit(self, fleet: Fleet) -> None:
        set_max_rate(fleet, _SLOW_HZ)
        passage = self._watched(fleet, "640x480", _USUAL_HZ, 40 if self._quick else 100)
        set_max_rate(fleet, 0.0)
        found_hz, what = passage.stamped_hz, f"max_rate {_SLOW_HZ:g}, camera {_USUAL_HZ:g} Hz"
        self._add(row("node", what, 0, [found_hz], unit="Hz"))
        deviation = 100 * abs(found_hz / _SLOW_HZ - 1)
        self.goals.append(Goal("deviation from max_rate [%]", 0, deviation, True, 2.0))

    def _idle(self, fleet: Fleet) -> None:
        image = image_file((480, 640), self._folder)
        share = fleet.idle_cpu_share(_NODE, image, rate_hz=_USUAL_HZ, duration_s=_IDLE_S)
        self._add(row("node", "nobody listens", 0, [100 * share], unit="% of a core"))
        self.goals.append(Goal("nobody listens [% of a core]", 0, 100 * share, True, 2.0))


def set_max_rate(fleet: Fleet, rate_hz: float) -> None:
    """Set it on every node; raises RuntimeError if it is refused."""
    for node in fleet.nodes:
        if refusal := node.set_parameters(max_rate=rate_hz):
            raise RuntimeError(f"setting max_rate={rate_hz} was refused: {refusal}")


def forward_goals(medians_ms: Mapping[str, float], busy: int) -> list[Goal]:
    """Goals for the medians of forward passes and stages, by name, next to `busy` processes."""
    auto_ms = medians_ms[_AUTO]
    rival_ms = min(medians_ms[name] for name in _BEST_RIVALS if name in medians_ms)
    return [
        Goal("forward / best bare rival", busy, auto_ms / rival_ms, True, 1.10),
        Goal(f"{_USUAL} / forward", busy, medians_ms[_USUAL] / auto_ms, False, 4.0 if busy else 2.2),
        Goal("detector / forward", busy, medians_ms["detector"] / auto_ms, True, 1.20),
    ]


def measured(options: argparse.Namespace, folder: Path) -> Figures:
    """All parts."""
    gc.disable()  # a full collection would stop the detection subscriber for 0.2 s
    bench = Bench(options, folder)
    for part in (bench.forwards, bench.node):
        print(f"measuring: {part.__doc__}", flush=True)
        part()
    return bench.rows, bench.goals


PROGRAM = Program(
    "bench",
    __doc__,
    measured,
    {
        "--quick": quick("fewer rounds, one size"),
        "--weights": {"type": Path, "help": "if not an untrained yolov5n"},
        "--size": {"default": "1280x720", "choices": SIZES_WH, "help": "of the image"},
        "--busy": {"type": int, "default": 1, "help": "number of busy processes"},
    },
)
parser = PROGRAM.parser


if __name__ == "__main__":
    sys.exit(PROGRAM.main())
