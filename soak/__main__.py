"""Runs the soak trials, prints a table, writes build/soak/report.json: `make soak SOAK_FLAGS=--help`."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path

from soak.cycles import complete_cycles
from soak.endings import ENDINGS, MOMENTS, clean_endings, clean_restarts
from soak.finding import Finding, found, table, write_report
from soak.mixed_life import mixed_life
from soak.subject import BalanceWatch, Subject, exact_balance, subject

_REPORT = Path("build") / "soak" / "report.json"
_CYCLES, _WARM_UP = 2000, 50
_TIMES = 20
NAMES = ("cycles", "mixed", "endings", "restarts")

Trial = Callable[[], Finding]


def _trials(options: argparse.Namespace, watches: list[BalanceWatch]) -> dict[str, Trial]:
    """By name; those on one process each add its balances to `watches`."""

    def in_own_process(trial: Callable[[Subject], Finding]) -> Trial:
        def run() -> Finding:
            with subject() as process:
                watches.append(process.balance)
                return trial(process)

        return run

    times, seed = _scaled(_TIMES, options.scale), options.seed
    cycles = _scaled(_CYCLES, options.scale)
    return {
        "cycles": in_own_process(lambda process: complete_cycles(process, cycles, _WARM_UP)),
        "mixed": in_own_process(lambda process: mixed_life(process, seed, options.minutes)),
        "endings": lambda: clean_endings(ENDINGS * times, seed),
        "restarts": lambda: clean_restarts([*MOMENTS] * times, seed),
    }


def _scaled(count: int, scale: float) -> int:
    return max(1, round(count * scale))


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
    parser.add_argument("--only", nargs="+", choices=NAMES, default=NAMES, metavar="TRIAL", help="some")
    return parser


def main(arguments: list[str] | None = None) -> int:
    """Return 0 if every claim holds, 1 otherwise."""
    options = parser().parse_args(arguments)
    watches: list[BalanceWatch] = []
    trials = _trials(options, watches)
    findings: list[Finding] = []
    for name in filter(options.only.__contains__, NAMES):
        print(f"{name} ...", file=sys.stderr, flush=True)
        findings.append(found(name, trials[name]))
        write_report(_REPORT, vars(options), findings)  # after each trial, as a trial may take hours
    if watches:
        findings.append(exact_balance(watches))
        write_report(_REPORT, vars(options), findings)
    print(table(findings))
    return 0 if all(finding.is_met for finding in findings) else 1


if __name__ == "__main__":
    sys.exit(main())
