"""Runs the soak trials, prints a table, writes build/soak/report.json: `make soak SOAK_FLAGS=--help`."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path

from soak.balance import BalanceWatch, exact_balance
from soak.collecting import collected_on_bad_disks
from soak.console_requests import refused_strangers
from soak.cycles import complete_cycles
from soak.endings import ENDINGS, MOMENTS, clean_endings, clean_restarts
from soak.faults import survived_faults
from soak.finding import Finding, found, table, write_report
from soak.images import rejected, survived
from soak.largest_images import LARGEST_SIDE_PX, bounded_decoding
from soak.mixed_life import mixed_life
from soak.service_requests import answered_requests
from soak.subject import Subject, subject

_REPORT = Path("build") / "soak" / "report.json"
_SEEDS = 5
_REQUESTS_PER_SEED = 4000
_IMAGES = 10_000
_CYCLES, _WARM_UP = 2000, 50
_STRANGERS = 10_000
_TIMES = 20
_FAULTS = 50

Trial = Callable[[], Finding]
Watched = Callable[[Subject], Finding]


def _watched_trials(seed: int, minutes: float, scale: float) -> dict[str, Watched]:
    """Trials on one process each, by name."""
    images, seeds = _scaled(_IMAGES, scale), range(seed, seed + _SEEDS)
    return {
        "requests": lambda process: answered_requests(process, seeds, _scaled(_REQUESTS_PER_SEED, scale)),
        "images": lambda process: rejected("raw", process, images, seed),
        "files": lambda process: rejected("compressed", process, images, seed),
        "largest-files": lambda process: bounded_decoding(process, LARGEST_SIDE_PX),
        "damaged-files": lambda process: survived("compressed", process, images, seed),
        "damaged-messages": lambda process: survived("raw", process, images, seed),
        "cycles": lambda process: complete_cycles(process, _scaled(_CYCLES, scale), _WARM_UP),
        "faults": lambda process: survived_faults(process, _scaled(_FAULTS, scale)),
        "mixed": lambda process: mixed_life(process, seed, minutes),
        "console": lambda process: refused_strangers(process, _scaled(_STRANGERS, scale), seed),
    }


def _trials_of_many(seed: int, scale: float) -> dict[str, Trial]:
    """Trials that start processes themselves, by name."""
    times = _scaled(_TIMES, scale)
    return {
        "endings": lambda: clean_endings(ENDINGS * times, seed),
        "collecting": lambda: collected_on_bad_disks(times, seed),
        "restarts": lambda: clean_restarts([*MOMENTS] * times, seed),
    }


def _scaled(count: int, scale: float) -> int:
    return max(1, round(count * scale))


_NAMES = [*_watched_trials(0, 0, 1), *_trials_of_many(0, 1)]


def parser() -> argparse.ArgumentParser:
    """The argument parser."""
    parser = argparse.ArgumentParser(
        prog="make soak",
        description="Long trials of the detector process.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    parser.add_argument("--minutes", type=float, default=30.0, help="duration of the mixed trial")
    parser.add_argument("--scale", type=float, default=1.0, help="factor on the number of attempts")
    parser.add_argument("--seed", type=int, default=0, help="seed of random choices")
    parser.add_argument("--only", nargs="+", choices=_NAMES, default=_NAMES, metavar="TRIAL", help="some")
    return parser


def main(arguments: list[str] | None = None) -> int:
    """Return 0 if every claim holds, 1 otherwise."""
    options = parser().parse_args(arguments)
    watches: list[BalanceWatch] = []
    trials = _trials_of_many(options.seed, options.scale) | {
        name: _in_own_process(trial, watches)
        for name, trial in _watched_trials(options.seed, options.minutes, options.scale).items()
    }
    findings: list[Finding] = []
    for name in filter(options.only.__contains__, _NAMES):
        print(f"{name} ...", file=sys.stderr, flush=True)
        findings.append(found(name, trials[name]))
        write_report(_REPORT, vars(options), findings)  # after each trial, as a trial may take hours
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
