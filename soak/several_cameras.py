"""Several cameras on one model while some come and go, and one is hostile."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Mapping

from soak.cameras_life import NAMES, RATE_HZ, STEADY, CamerasLife
from soak.finding import Finding, number_of
from soak.subject import Subject

_CHECK_EVERY = 20
_MIN_SHARE = 0.95
_MAX_GROWTH_MB = 20.0
_WARM_UP = 4
"""The memory in this part of all checks, one of so many, is what it may grow from."""


def several_cameras(subject: Subject, seed: int, minutes: float, *, is_judged: bool = True) -> Finding:
    """Do everything once, then at random for `minutes`; share and memory only decide if `is_judged`."""
    resident_mb: list[float] = []
    with CamerasLife(subject, seed) as life:
        begun_s, before = time.monotonic(), _steady_counts(subject)
        kinds = life.kinds
        while not resident_mb or time.monotonic() < begun_s + 60 * minutes:
            for kind in kinds:
                life.act(kind)
            life.check()
            kinds = life.random_kinds(_CHECK_EVERY)
            resident_mb.append(subject.resources().resident_mb)
        taken_s = time.monotonic() - begun_s
        share = _min_share(before, _steady_counts(subject))
    subject.reset()
    escaped = subject.escaped  # reads the log to its end, in which the balances of removed cameras are
    problems = [*life.problems, *life.track_ids.problems, *subject.balance.problems]
    warm = len(resident_mb) // _WARM_UP
    growth_mb = max(resident_mb[-warm - 1 :]) - max(resident_mb[: warm + 1])
    return Finding(
        claim="cameras that come, go and misbehave disturb neither the others nor the process",
        done=f"{life.done.total()} actions of {len(life.done)} kinds on {len(NAMES)} cameras in "
        f"{taken_s / 60:.0f} minutes, {len(life.track_ids)} tracks, seed {seed}",
        result=f"{number_of('wrong answers, counts or track ids', problems)}, "
        f"{number_of('exceptions', escaped)}; "
        f"{share:.1%} of the images of the steady cameras ({RATE_HZ:g} Hz) detected; "
        f"RSS {growth_mb:+.1f} MB",
        limit=f"0, 0; {f'{_MIN_SHARE:.0%}; < {_MAX_GROWTH_MB:+g} MB' if is_judged else 'not judged'}",
        is_met=not problems
        and not escaped
        and (not is_judged or (share >= _MIN_SHARE and growth_mb < _MAX_GROWTH_MB)),
    )


def _steady_counts(subject: Subject) -> dict[str, Counter[str]]:
    """Images of the steady cameras so far, by what has become of them."""
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
