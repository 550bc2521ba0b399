"""Repeated lifecycle cycles of one process, with a check for resource leaks."""

from __future__ import annotations

from collections.abc import Sequence

from soak.finding import Finding, number_of
from soak.subject import Resources, Subject, camera

_RATE_HZ = 30.0
_MAX_GROWTH_MB = 5.0


def complete_cycles(subject: Subject, count: int, warm_up: int, *, weigh: bool = True) -> Finding:
    """Configure, activate, detect, deactivate, clean up, with a camera; memory is only judged if `weigh`.

    Compares the resources of the process after `warm_up` cycles and at the end, over some cycles each. A
    counted thread may be about to end, so the min at the end must not exceed the max at the start.
    """
    subject.reset()
    held: list[Resources] = []
    with camera(subject.domain, rate=_RATE_HZ, width=320, height=240):
        for _ in range(warm_up + count):
            subject.detections.clear()
            subject.bring_to("active")
            subject.observer.wait_for(lambda: bool(subject.detections), "detections")
            subject.bring_to("unconfigured")
            held.append(subject.resources())
    first, last = _parts(held[warm_up:])
    growth_mb = max(has.resident_mb for has in last) - max(has.resident_mb for has in first)
    threads = max(has.threads for has in first), min(has.threads for has in last)
    files = max(has.files for has in first), min(has.files for has in last)
    is_constant = threads[0] >= threads[1] and files[0] >= files[1]
    return Finding(
        claim="full lifecycle cycles leave nothing behind",
        done=f"{count} cycles at {_RATE_HZ:g} Hz after {warm_up} of warm-up",
        result=f"0 failed; RSS {growth_mb:+.1f} MB, threads {threads[0]} -> {threads[1]}, "
        f"files {files[0]} -> {files[1]}; {number_of('exceptions', subject.escaped)}",
        limit=f"RSS {f'< {_MAX_GROWTH_MB:+g} MB' if weigh else 'not judged'}, threads and files constant",
        is_met=is_constant and (growth_mb < _MAX_GROWTH_MB or not weigh) and not subject.escaped,
    )


def _parts(held: Sequence[Resources]) -> tuple[Sequence[Resources], Sequence[Resources]]:
    """The first and the last tenth of `held`, at least two cycles each."""
    size = max(len(held) // 10, 2)
    return held[:size], held[-size:]
