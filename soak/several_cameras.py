"""Several cameras on one model, of which one is hostile."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from soak.cameras_life import NAMES, RATE_HZ, STEADY, CamerasLife
from soak.finding import Finding, number_of
from soak.subject import Subject

_CHECK_EVERY = 20
_MIN_SHARE = 0.95
_MAX_GROWTH_MB = 20.0
_WARM_UP = 4
"""Memory growth is measured against the first of this many equal parts of the checks."""


@dataclass(frozen=True)
class _Outcome:
    """`share` of the images of the steady cameras that were detected; `resident_mb` at each check."""

    taken_s: float
    share: float
    resident_mb: Sequence[float]

    @property
    def growth_mb(self) -> float:
        warm = len(self.resident_mb) // _WARM_UP
        return max(self.resident_mb[-warm - 1 :]) - max(self.resident_mb[: warm + 1])


def several_cameras(subject: Subject, seed: int, minutes: float, *, is_judged: bool = True) -> Finding:
    """Do every action once, then random ones for `minutes`; share and memory count only if `is_judged`."""
    with CamerasLife(subject, seed) as life:
        outcome = _outcome(subject, life, minutes)
    subject.reset()
    escaped = subject.escaped
    problems = [*life.problems, *life.track_ids.problems, *subject.balance.problems]
    are_fine = outcome.share >= _MIN_SHARE and outcome.growth_mb < _MAX_GROWTH_MB
    return Finding(
        claim="cameras that misbehave disturb neither the others nor the process",
        done=f"{life.done.total()} actions of {len(life.done)} kinds on {len(NAMES)} cameras in "
        f"{outcome.taken_s / 60:.0f} minutes, {len(life.track_ids)} tracks, "
        f"{sum(client.heard_3d for client in life.clients.values())} images with depth, seed {seed}",
        result=f"{number_of('wrong answers, counts or track ids', problems)}, "
        f"{number_of('exceptions', escaped)}; {outcome.share:.1%} of the images of the steady cameras "
        f"({RATE_HZ:g} Hz) detected; RSS {outcome.growth_mb:+.1f} MB",
        limit=f"0, 0; {f'{_MIN_SHARE:.0%}; < {_MAX_GROWTH_MB:+g} MB' if is_judged else 'not judged'}",
        is_met=not problems and not escaped and (are_fine or not is_judged),
    )


def _outcome(subject: Subject, life: CamerasLife, minutes: float) -> _Outcome:
    begun_s, before = time.monotonic(), _steady_counts(subject)
    resident_mb: list[float] = []
    kinds = life.kinds
    while not resident_mb or time.monotonic() < begun_s + 60 * minutes:
        for kind in kinds:
            life.act(kind)
        life.check()
        kinds = life.random_kinds(_CHECK_EVERY)
        resident_mb.append(subject.resources().resident_mb)
    taken_s = time.monotonic() - begun_s
    return _Outcome(taken_s, _min_share(before, _steady_counts(subject)), resident_mb)


def _steady_counts(subject: Subject) -> dict[str, Counter[str]]:
    """Images of the steady cameras so far, by outcome."""
    statuses = subject.statuses()
    return {
        name: Counter({key: int(value) for key, value in statuses[name].items() if key.startswith("frames ")})
        for name in STEADY
    }


def _min_share(before: Mapping[str, Counter[str]], after: Mapping[str, Counter[str]]) -> float:
    """The smallest share of the images sent that was detected."""
    counts = [after[name] - before[name] for name in STEADY]
    sent = ("frames received", "frames lost", "frames overtaken")
    return min(count["frames detected"] / sum(count[key] for key in sent) for count in counts)
