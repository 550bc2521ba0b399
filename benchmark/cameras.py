"""Several cameras on one node compared with one node per camera, and how cameras share a node.

python -m benchmark.cameras [--counts 1 2 4 8] [--rate 10] [--quick]
"""

from __future__ import annotations

import argparse
import itertools
import statistics
import sys
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path

from benchmark.camera_fleet import LAYOUTS, Arrival, Fleet, Layout, Passage, active_fleet, materials
from benchmark.report import Figures, Goal, Program, Row, in_turns, quick, row

IMAGE_HW = (480, 640)
FOLLOWED = 4
"""Number of cameras whose comparison has goals."""
MAX_DEVIATION_PERCENT = 5.0
_SHARING_HZ = 20.0
_SLOW_HZ, _FAST_HZ = 5.0, 120.0


class CameraBench:
    """One run: measurements are collected in `rows`, comparisons in `goals`."""

    def __init__(self, folder: Path, *, quick: bool) -> None:
        self.rows: list[Row] = []
        self.goals: list[Goal] = []
        self._weights, self._image = materials(IMAGE_HW, folder)
        self._folder = folder
        self._rounds, self._passage_s, self._shares_s = (1, 4.0, 10.0) if quick else (3, 10.0, 60.0)

    def choose_runtime(self) -> None:
        """Let one detector measure the runtimes, alone; the others use its choice."""
        with active_fleet("a node each", ["first"], weights=self._weights, cache=self._folder):
            pass

    def layouts(self, count: int, rate_hz: float) -> None:
        """Measure one node for all cameras and a node for each, alternately."""
        calls = {layout: partial(self._passage, layout, count, rate_hz) for layout in LAYOUTS}
        passages = in_turns(calls, self._rounds, mirrored=True)
        for layout, passed in passages.items():
            self.rows += layout_rows(layout, count, passed)
        ratios = ratios_of(*(passages[layout] for layout in LAYOUTS))
        for what, values in ratios.items():
            self.rows.append(row(_cameras(count), f"one node / a node each, {what}", 0, values, unit="x"))
        if count == FOLLOWED:
            self.goals += layout_goals({what: statistics.median(values) for what, values in ratios.items()})

    def fairness(self) -> None:
        """How cameras share one node: equal ones, a slow beside a fast one."""
        names, rates_hz = _names(FOLLOWED), (_SLOW_HZ, _FAST_HZ)
        passages = [self._passage_s] * self._rounds
        with active_fleet("one node", names, weights=self._weights, cache=self._folder) as fleet:
            equal = equal_shares(fleet, names, self._image, rate_hz=_SHARING_HZ, duration_s=self._shares_s)
            beside = slow_beside_fast(
                fleet, (names[0], names[1]), self._image, rates_hz=rates_hz, passages=passages
            )
        for rows, goals in (equal, beside):
            self.rows += rows
            self.goals += goals

    def _passage(self, layout: Layout, count: int, rate_hz: float) -> Passage:
        """Measure with new processes, so that nothing but this layout is in memory."""
        names = _names(count)
        fleet_of = active_fleet(layout, names, weights=self._weights, cache=self._folder)
        with fleet_of as fleet, ExitStack() as stack:
            for name in names:
                stack.enter_context(fleet.camera(name, self._image, rate_hz=rate_hz))
            fleet.wait_for(names)
            return fleet.watch(names, self._passage_s)


def share_deviation_percent(counts: Sequence[int]) -> float:
    """By how much the smallest count is below the largest."""
    return 100 * (1 - min(counts) / max(counts)) if max(counts) else 100.0


def overtaking(arrivals: Iterable[Arrival], slow: str) -> list[int]:
    """For each detected image of the camera `slow`: how many younger images were detected before it."""
    stamps_ns: list[int] = []
    counts = []
    for arrival in arrivals:
        if arrival.camera == slow:
            counts.append(sum(stamp_ns > arrival.stamp_ns for stamp_ns in stamps_ns))
        else:
            stamps_ns.append(arrival.stamp_ns)
    return counts


def equal_shares(
    fleet: Fleet, names: Sequence[str], image: Path, *, rate_hz: float, duration_s: float
) -> tuple[list[Row], list[Goal]]:
    """Cameras of equal rate that together send more than can be detected."""
    with ExitStack() as stack:
        for name in names:
            stack.enter_context(fleet.camera(name, image, rate_hz=rate_hz))
        fleet.wait_for(names)
        passage = fleet.watch(names, duration_s)
    counts = [passage.counts[name] for name in names]
    deviation = share_deviation_percent(counts)
    what = f"{len(names)} cameras of {rate_hz:g} Hz, share"
    unit = f"images in {passage.duration_s:.0f} s"
    rows = [row("fairness", what, 0, [float(count) for count in counts], unit=unit)]
    return rows, [Goal("shares differ by [%]", 0, deviation, True, MAX_DEVIATION_PERCENT)]


def slow_beside_fast(
    fleet: Fleet,
    names: tuple[str, str],
    image: Path,
    *,
    rates_hz: tuple[float, float],
    passages: Iterable[float],
) -> tuple[list[Row], list[Goal]]:
    """A slow camera, alternately alone and next to a fast one, for each duration in `passages`."""
    (slow, fast), (slow_hz, fast_hz) = names, rates_hz
    alone_ms: list[float] = []
    beside_ms: list[float] = []
    gaps_ms: list[float] = []
    overtaken: list[int] = []
    with fleet.camera(slow, image, rate_hz=slow_hz):
        for duration_s in passages:
            fleet.wait_for([slow])
            alone_ms += fleet.watch([slow], duration_s).latencies_ms
            with fleet.camera(fast, image, rate_hz=fast_hz):
                fleet.wait_for([slow, fast])
                arrivals = fleet.watch([slow, fast], duration_s).arrivals
            beside_ms += [arrival.latency_ms for arrival in arrivals if arrival.camera == slow]
            gaps_ms += _gaps_ms(arrivals)
            overtaken += overtaking(arrivals, slow)
    delay = (statistics.median(beside_ms) - statistics.median(alone_ms)) / statistics.median(gaps_ms)
    late = 100 * sum(count > 1 for count in overtaken) / len(overtaken)
    rows = [
        row("fairness", f"{slow_hz:g} Hz alone", 0, alone_ms),
        row("fairness", f"{slow_hz:g} Hz beside {fast_hz:g} Hz", 0, beside_ms),
        row("fairness", "both, between two detections", 0, gaps_ms),
        row("fairness", "younger images served before", 0, [float(c) for c in overtaken], unit="images"),
    ]
    return rows, [
        Goal("delay by a fast camera [inferences]", 0, delay, True, 1.0),
        Goal("delayed by more than one [%]", 0, late, True, MAX_DEVIATION_PERCENT),
    ]


def _gaps_ms(arrivals: Sequence[Arrival]) -> list[float]:
    pairs = itertools.pairwise(arrivals)
    return [(after.received_ns - before.received_ns) / 1e6 for before, after in pairs]


def layout_rows(layout: Layout, count: int, passages: Sequence[Passage]) -> list[Row]:
    """The figures of one layout: latencies of all images, the others once for each passage."""
    figures = {
        "detections": ([passage.rate_hz for passage in passages], "Hz"),
        "latency": ([latency for passage in passages for latency in passage.latencies_ms], "ms"),
        "CPU": ([passage.cpu_percent for passage in passages], "% of a core"),
        "CPU a detection": ([passage.cpu_ms for passage in passages], "ms of a core"),
        "memory (PSS)": ([passage.proportional_mb for passage in passages], "MB"),
        "memory (RSS)": ([passage.resident_mb for passage in passages], "MB"),
    }
    return [
        row(_cameras(count), f"{layout}, {what}", 0, values, unit=unit)
        for what, (values, unit) in figures.items()
    ]


def ratios_of(one_node: Sequence[Passage], a_node_each: Sequence[Passage]) -> dict[str, list[float]]:
    """Figures of one node divided by those of a node each, in every round."""
    figures: dict[str, Callable[[Passage], float]] = {
        "detections": lambda passage: passage.rate_hz,
        "median": lambda passage: statistics.median(passage.latencies_ms),
        "p95": lambda passage: row("", "", 0, passage.latencies_ms).p95,
        "CPU": lambda passage: passage.cpu_ms,
        "PSS": lambda passage: passage.proportional_mb,
        "RSS": lambda passage: passage.resident_mb,
    }
    pairs = list(zip(one_node, a_node_each, strict=True))
    return {what: [figure(one) / figure(each) for one, each in pairs] for what, figure in figures.items()}


def layout_goals(ratios: dict[str, float]) -> list[Goal]:
    """Goals for the medians of the ratios, by their names in `ratios_of`."""
    whose = f"{FOLLOWED} cameras, one node / a node each"
    return [
        Goal(f"{whose}: detections", 0, ratios["detections"], False, 1.0),
        Goal(f"{whose}: memory (PSS)", 0, ratios["PSS"], True, 0.4),
        Goal(f"{whose}: latency p95", 0, ratios["p95"], True, 1.0),
    ]


def measured(options: argparse.Namespace, folder: Path) -> Figures:
    """Both layouts for each number of cameras, then how they share."""
    counts = options.counts or ((1, FOLLOWED) if options.quick else (1, 2, FOLLOWED, 8))
    bench = CameraBench(folder, quick=options.quick)
    bench.choose_runtime()
    for count in counts:
        print(f"measuring: {_cameras(count)}, one node and a node each", flush=True)
        bench.layouts(count, options.rate)
    print(f"measuring: {bench.fairness.__doc__}", flush=True)
    bench.fairness()
    return bench.rows, bench.goals


def _names(count: int) -> list[str]:
    return [f"camera_{number}" for number in range(1, count + 1)]


def _cameras(count: int) -> str:
    return f"{count} camera{'s' if count > 1 else ''}"


PROGRAM = Program(
    "cameras",
    __doc__,
    measured,
    {
        "--quick": quick("1 and 4 cameras, one round, shorter"),
        "--counts": {"type": int, "nargs": "+", "help": "if not 1, 2, 4 and 8 cameras"},
        "--rate": {"type": float, "default": 10.0, "help": "of each camera's images, in Hz"},
    },
)
parser = PROGRAM.parser


if __name__ == "__main__":
    sys.exit(PROGRAM.main())
