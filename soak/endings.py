"""Processes that are terminated or killed at any moment."""

from __future__ import annotations

import math
import signal
import time
from collections import Counter
from collections.abc import Callable, Iterable
from functools import partial
from random import Random
from typing import Any

from soak.finding import Finding, number_of, problem
from soak.subject import Subject, subject, subject_in
from yolov5_lifecycle.ros.child_process import own_domain

_LIMIT_S = 5.0
_TRANSITION_S = 0.001, 0.3
"""Min and max duration of a transition."""
_PAUSE_S = 0.001

Ending = tuple[signal.Signals, str]
"""The signal, and a moment from `MOMENTS`."""
Reach = Callable[[Subject], Any]
"""Brings the subject to a moment; returns the future of a transition in progress, else None."""


def _in_state(state: str) -> Reach:
    def reach(subject: Subject) -> None:
        subject.bring_to(state)
        if state == "active":
            subject.look()

    return reach


def _during(label: str, state: str) -> Reach:
    def reach(subject: Subject) -> Any:
        subject.bring_to(state)
        return subject.begin_transition(label)

    return reach


def _during_reload(subject: Subject) -> Any:
    subject.bring_to("active")
    return subject.begin_reload(416)


MOMENTS = {
    "unconfigured": _in_state("unconfigured"),
    "inactive": _in_state("inactive"),
    "active": _in_state("active"),
    "configuring": _during("configure", "unconfigured"),
    "activating": _during("activate", "inactive"),
    "deactivating": _during("deactivate", "active"),
    "cleaning up": _during("cleanup", "inactive"),
    "reloading": _during_reload,
}
ENDINGS: tuple[Ending, ...] = tuple(
    (number, moment) for number in (signal.SIGINT, signal.SIGTERM) for moment in MOMENTS
)


def clean_endings(endings: Iterable[Ending], seed: int, *, limit_s: float = _LIMIT_S) -> Finding:
    """Terminate a new process at each moment, during a transition or shortly after it."""
    random, endings, met = Random(seed), list(endings), Counter[str]()
    wrong = [*filter(None, (problem(partial(_end, *ending, random, met, limit_s)) for ending in endings))]
    return Finding(
        claim="SIGINT and SIGTERM end the process cleanly at any moment",
        done=f"{len(endings)} processes, seed {seed}",
        result=f"{number_of('other ends', wrong)}; on their way: {_counts(met)}",
        limit=f"0; exit code 0 within {limit_s:g} s, no exception",
        is_met=not wrong,
    )


def clean_restarts(moments: Iterable[str], seed: int) -> Finding:
    """Kill a process at each moment; the next one in its domain must configure, activate and detect."""
    random, moments = Random(seed), list(moments)
    wrong = [*filter(None, (problem(partial(_restart, moment, random)) for moment in moments))]
    return Finding(
        claim="a killed process is replaced by a clean one",
        done=f"SIGKILL for {len(moments)} processes, seed {seed}",
        result=number_of("successors did not detect, or end with 0", wrong),
        limit="0",
        is_met=not wrong,
    )


def _counts(met: Counter[str]) -> str:
    return ", ".join(f"{moment} {count}" for moment, count in met.items() if count) or "none"


def _end(number: signal.Signals, moment: str, random: Random, met: Counter[str], limit_s: float) -> None:
    with subject() as process:
        met[moment] += _reach(process, moment, random)
        code = process.process.stop(number, timeout_s=limit_s)
        assert (code, process.escaped) == (0, []), f"{number.name} {moment}: {code}, {process.escaped}"


def _restart(moment: str, random: Random) -> None:
    with own_domain() as domain:
        with subject_in(domain) as killed:
            _reach(killed, moment, random)
            assert killed.process.stop(signal.SIGKILL) == -signal.SIGKILL
        with subject_in(domain) as process:
            process.bring_to("active")
            process.look()
            code = process.process.stop(signal.SIGTERM)
            assert (code, process.escaped) == (0, []), f"after {moment}: {code}, {process.escaped}"


def _reach(subject: Subject, moment: str, random: Random) -> bool:
    """Bring the subject to `moment` and wait randomly; returns whether a transition is in progress then."""
    answer = MOMENTS[moment](subject)
    shortest, longest = map(math.log, _TRANSITION_S)
    time.sleep(math.exp(random.uniform(shortest, longest)))
    subject.observer.work_for(_PAUSE_S)
    return answer is not None and not answer.done()
