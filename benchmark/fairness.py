"""How cameras share one node."""

from __future__ import annotations

import itertools
import statistics
from collections.abc import Iterable, Sequence
from contextlib import ExitStack
from pathlib import Path

from benchmark.camera_fleet import Arrival, Fleet
from benchmark.report import Goal, Row, row

MAX_DEVIATION_PERCENT = 5.0


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
