"""How cameras share one node, and what a misbehaving one costs the others."""

from __future__ import annotations

import itertools
import os
import signal
import statistics
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path

from benchmark.camera_fleet import Arrival, Fleet
from benchmark.report import Goal, Row, row

MANNERS = ("like the others", "stalled", "vanished", "sending garbage", "changing size")
MAX_DEVIATION_PERCENT = 5.0
_WELL = MANNERS[0]
_SIGNALS = {"stalled": signal.SIGSTOP, "vanished": signal.SIGKILL}
_GARBAGE = 10
"""Factor on the usual rate for a camera that sends unreadable images."""


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
) -> tuple[float, list[Row], list[Goal]]:
    """Cameras of equal rate that together send more than can be detected; also returns the total rate."""
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
    return passage.rate_hz, rows, [_deviation_goal("shares differ by [%]", deviation)]


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


def others_rates(
    fleet: Fleet,
    names: Sequence[str],
    image: Path,
    *,
    rate_hz: float,
    passages: Sequence[float],
    manners: Sequence[str] = MANNERS,
) -> tuple[list[Row], list[Goal]]:
    """Rate of all cameras but the last, which behaves in each of `manners` in turn."""
    *others, last = names
    rates_hz: dict[str, list[float]] = {manner: [] for manner in manners}
    with ExitStack() as stack:
        for name in others:
            stack.enter_context(fleet.camera(name, image, rate_hz=rate_hz))
        for duration_s in passages:
            for manner in manners:
                with _behaving(fleet, last, image, manner, rate_hz):
                    fleet.wait_for(others)
                    passage = fleet.watch(others, duration_s)
                detected = sum(passage.counts[name] for name in others)
                rates_hz[manner].append(detected / passage.duration_s)
    rows = [row("others", f"beside one {manner}", 0, hz, unit="Hz") for manner, hz in rates_hz.items()]
    changes = {manner: _change_percent(hz, rates_hz[_WELL]) for manner, hz in rates_hz.items()}
    return rows, [
        _deviation_goal(f"others' rate changed beside one {manner} [%]", percent)
        for manner, percent in changes.items()
        if manner != _WELL
    ]


@contextmanager
def _behaving(fleet: Fleet, name: str, image: Path, manner: str, rate_hz: float) -> Iterator[None]:
    is_other_camera = manner not in (_WELL, *_SIGNALS)
    rate_hz *= _GARBAGE if manner == "sending garbage" else 1
    with fleet.camera(name, image, rate_hz=rate_hz, manner=manner if is_other_camera else "") as process:
        if manner in _SIGNALS:
            fleet.wait_for([name])
            os.kill(process.process_id, _SIGNALS[manner])
        yield


def _change_percent(rates_hz: Sequence[float], usual_hz: Sequence[float]) -> float:
    ratios = [rate / usual for rate, usual in zip(rates_hz, usual_hz, strict=True)]
    return 100 * abs(statistics.median(ratios) - 1)


def _gaps_ms(arrivals: Sequence[Arrival]) -> list[float]:
    pairs = itertools.pairwise(arrivals)
    return [(after.received_ns - before.received_ns) / 1e6 for before, after in pairs]


def _deviation_goal(what: str, percent: float) -> Goal:
    return Goal(what, 0, percent, True, MAX_DEVIATION_PERCENT)
