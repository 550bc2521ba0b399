"""What all benchmarks share: a program with options, measuring in turns, rows and goals, table and JSON."""

from __future__ import annotations

import argparse
import json
import math
import os
import platform
import statistics
import tempfile
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any, TypeVar

FOLDER = Path(__file__).parents[1] / "build" / "bench"
STAGE = "stage"
_WARM_UPS = 5
_PACKAGES = ("torch", "onnxruntime", "openvino", "opencv-python-headless", "numpy")
Name = TypeVar("Name")
Measured = TypeVar("Measured")


@dataclass(frozen=True)
class Row:
    """One measurement under one load; `spread` is the interquartile range divided by the median."""

    what: str
    name: str
    busy: int
    median: float
    p95: float
    spread: float
    unit: str


@dataclass(frozen=True)
class Goal:
    """A figure and its upper or lower `bound`."""

    what: str
    busy: int
    value: float
    at_most: bool
    bound: float

    @property
    def is_reached(self) -> bool:
        return self.value <= self.bound if self.at_most else self.value >= self.bound


Figures = tuple[Sequence[Row], Sequence[Goal]]


@dataclass(frozen=True)
class Program:
    """`python -m benchmark.NAME`; `about` is the docstring of its module."""

    name: str
    about: str | None
    measure: Callable[[argparse.Namespace, Path], Figures]
    """Called with the options and an empty folder."""
    options: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """Arguments of `add_argument` by name."""
    is_judged: bool = False
    """Whether the exit status tells that a goal was missed."""

    def parser(self) -> argparse.ArgumentParser:
        parser = argparse.ArgumentParser(
            prog=f"benchmark.{self.name}",
            description=(self.about or "").partition("\n")[0],
            formatter_class=argparse.ArgumentDefaultsHelpFormatter,
        )
        for name, given in self.options.items():
            parser.add_argument(name, **given)
        return parser

    def main(self, arguments: Sequence[str] | None = None) -> int:
        """Measure, print and write the report; returns 1 if a goal that is judged was missed."""
        options = self.parser().parse_args(arguments)
        with tempfile.TemporaryDirectory(prefix="bench-") as folder:
            rows, goals = self.measure(options, Path(folder))
        _publish(self.name, options, rows, goals)
        return int(self.is_judged and not all(goal.is_reached for goal in goals))


def quick(what: str) -> dict[str, Any]:
    """The option --quick; `what` it does."""
    return {"action": "store_true", "help": what}


def size_hw(text: str) -> tuple[int, int]:
    """Height and width of WIDTHxHEIGHT, as an option has it."""
    width, height = map(int, text.split("x"))
    return height, width


def in_turns(
    calls: Mapping[Name, Callable[[], Measured]], rounds: int, *, warm_ups: int = 0, mirrored: bool = False
) -> dict[Name, list[Measured]]:
    """What each call returns, one after the other in every round: noise of the machine affects all alike.

    The first `warm_ups` rounds are not counted; with `mirrored`, every second round goes backwards.
    """
    found: dict[Name, list[Measured]] = {name: [] for name in calls}
    for number in range(warm_ups + rounds):
        for name in [*calls][:: -1 if mirrored and number % 2 else 1]:
            measured = calls[name]()
            if number >= warm_ups:
                found[name].append(measured)
    return found


def timed(call: Callable[[], object], clock: Callable[[], float] = time.perf_counter) -> float:
    """Seconds that a call takes by `clock`."""
    begun_s = clock()
    call()
    return clock() - begun_s


def measured_ms(calls: Mapping[str, Callable[[], object]], turns: int) -> dict[str, list[float]]:
    """Milliseconds of processor time, of all threads, that each call takes in `turns` turns.

    Processor time depends less than elapsed time on what else the machine does.
    """
    timings = {name: partial(timed, call, time.process_time) for name, call in calls.items()}
    taken_s = in_turns(timings, turns, warm_ups=_WARM_UPS)
    return {name: [1e3 * time_s for time_s in times_s] for name, times_s in taken_s.items()}


def median_ratio(above: Iterable[float], below: Iterable[float]) -> float:
    """The median of the ratios within each round."""
    return statistics.median(one / other for one, other in zip(above, below, strict=True))


def row(what: str, name: str, busy: int, values: Sequence[float], *, unit: str = "ms") -> Row:
    """The statistics of `values`."""
    ordered = sorted(values)
    middle = statistics.median(ordered)
    low, high = (ordered[round(share * (len(ordered) - 1))] for share in (0.25, 0.75))
    p95 = ordered[math.ceil(0.95 * len(ordered)) - 1]
    return Row(what, name, busy, middle, p95, (high - low) / middle if middle else 0.0, unit)


def table(rows: Iterable[Row]) -> str:
    """Rows as lines, with the ratio to the smallest median of the same measurement under the same load.

    For a stage, its share of the longest stage, the total, instead.
    """
    rows = list(rows)
    width = max((len(each.what) + 1 for each in rows), default=0)
    heads = f"{'':{width}}{'':34}{'busy':>4}{'median':>10}{'p95':>10}{'spread':>8}{'ratio':>7}"
    lines = [heads, "-" * len(heads)]
    for each in rows:
        measured = each.what, each.busy, each.unit
        medians = [other.median for other in rows if (other.what, other.busy, other.unit) == measured]
        ratio = _ratio(each, min(medians), max(medians)) if each.unit == "ms" else ""
        lines.append(
            f"{each.what:{width}}{each.name:34}{each.busy:4}{each.median:10.2f}{each.p95:10.2f}"
            f"{each.spread:8.0%}{ratio:>7} {each.unit}"
        )
    return "\n".join(lines)


def _ratio(each: Row, shortest: float, longest: float) -> str:
    if each.what == STAGE:
        return f"{each.median / longest:.0%}" if longest else ""
    return f"{each.median / shortest:.2f}" if shortest else ""


def goal_table(goals: Iterable[Goal]) -> str:
    """Goals as lines."""
    return "\n".join(
        f"{'reached' if goal.is_reached else 'MISSED':8}{goal.what}, {goal.busy} busy: {goal.value:.2f} "
        f"({'at most' if goal.at_most else 'at least'} {goal.bound:g})"
        for goal in goals
    )


def _publish(name: str, options: argparse.Namespace, rows: Sequence[Row], goals: Sequence[Goal]) -> None:
    """Print both tables, write them with machine and versions to FOLDER/NAME.json."""
    report = {
        "options": {option: str(value) for option, value in vars(options).items()},
        "versions": {package: version(package) for package in _PACKAGES},
        "machine": {"cores": os.cpu_count(), "system": platform.platform(), "load": os.getloadavg()},
        "rows": [asdict(each) for each in rows],
        "goals": [asdict(goal) | {"is_reached": goal.is_reached} for goal in goals],
    }
    FOLDER.mkdir(parents=True, exist_ok=True)
    (FOLDER / f"{name}.json").write_text(json.dumps(report, indent=2) + "\n", encoding="utf-8")
    print(f"\n{table(rows)}\n\n{goal_table(goals)}\n\n{FOLDER / name}.json", flush=True)
