"""Runs the long trials, prints their table, writes build/soak/report.json: `make soak SOAK_FLAGS=--help`."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path

from soak.answer_times import answers_during_inference
from soak.balance import BalanceWatch, exact_balance
from soak.checkpoints import refused_checkpoints
from soak.cycles import complete_cycles
from soak.endings import ENDINGS, MOMENTS, clean_endings, clean_restarts, clean_starts
from soak.faults import ended_by_lost_devices, survived_faults
from soak.finding import Finding, found, table, write_report
from soak.images import rejected_files, rejected_images, survived_files, survived_messages
from soak.mixed_life import mixed_life
from soak.service_requests import answered_requests
from soak.subject import Subject, subject
from soak.transitions import answered_shutdowns, answered_transitions

_REPORT = Path("build") / "soak" / "report.json"
_SEEDS = 5
_REQUESTS_PER_SEED = 4000
_IMAGES = 10_000
_CYCLES, _WARM_UP = 2000, 50
_QUESTIONS = 5000
_TIMES = 20
_FAULTS = 50

Trial = Callable[[], Finding]
Watched = Callable[[Subject], Finding]


def _watched_trials(seed: int, minutes: float) -> dict[str, Watched]:
    """Trials of one process each, by name."""
    return {
        "transitions": answered_transitions,
        "requests": lambda process: answered_requests(
            process, range(seed, seed + _SEEDS), _REQUESTS_PER_SEED
        ),
        "images": lambda process: rejected_images(process, _IMAGES, seed),
        "files": lambda process: rejected_files(process, _IMAGES, seed),
        "damaged-files": lambda process: survived_files(process, _IMAGES, seed),
        "damaged-messages": lambda process: survived_messages(process, _IMAGES, seed),
        "answers": lambda process: answers_during_inference(process, _QUESTIONS),
        "cycles": lambda process: complete_cycles(process, _CYCLES, _WARM_UP),
        "faults": lambda process: survived_faults(process, _FAULTS),
        "mixed": lambda process: mixed_life(process, seed, minutes),
    }


def _trials_of_many(seed: int) -> dict[str, Trial]:
    """Trials that start processes themselves, by name."""
    return {
        "checkpoints": refused_checkpoints,
        "shutdowns": answered_shutdowns,
        "lost-devices": lambda: ended_by_lost_devices(_FAULTS),
        "endings": lambda: clean_endings(ENDINGS * _TIMES, seed),
        "starts": lambda: clean_starts(_TIMES, seed),
        "restarts": lambda: clean_restarts([*MOMENTS] * _TIMES, seed),
    }


_NAMES = [*_watched_trials(0, 0), *_trials_of_many(0)]


def parser() -> argparse.ArgumentParser:
    """Of the words of the command line."""
    parser = argparse.ArgumentParser(prog="make soak", description="Long trials of the detector's process.")
    parser.add_argument(
        "--minutes", type=float, default=30.0, help="of the mixed trial; default: %(default)s"
    )
    parser.add_argument("--seed", type=int, default=0, help="of all that is random; default: %(default)s")
    parser.add_argument(
        "--only",
        nargs="+",
        choices=_NAMES,
        default=_NAMES,
        metavar="TRIAL",
        help=f"some of: {', '.join(_NAMES)}",
    )
    return parser


def main(arguments: list[str] | None = None) -> int:
    """Returns 0 when every claim holds, 1 otherwise."""
    options = parser().parse_args(arguments)
    watches: list[BalanceWatch] = []
    trials = _trials_of_many(options.seed) | {
        name: _in_own_process(trial, watches)
        for name, trial in _watched_trials(options.seed, options.minutes).items()
    }
    findings: list[Finding] = []
    for name in filter(options.only.__contains__, _NAMES):
        print(f"{name} ...", file=sys.stderr, flush=True)
        findings.append(found(name, trials[name]))
        write_report(_REPORT, vars(options), findings)  # hours may lie between two of them
    if watches:
        findings.append(exact_balance(watches))
        write_report(_REPORT, vars(options), findings)
    print(table(findings))
    return 0 if all(finding.is_met for finding in findings) else 1


def _in_own_process(trial: Watched, watches: list[BalanceWatch]) -> Trial:
    def run() -> Finding:
        with subject() as process:
            watches.append(process.balance)
            return trial(process)

    return run


if __name__ == "__main__":
    sys.exit(main())
