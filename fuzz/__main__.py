"""Fuzzes each target in its own process: `make fuzz FUZZ_FLAGS=--help`."""

from __future__ import annotations

import argparse
import subprocess
import sys

from fuzz.targets import TARGETS

_PROCESS_S = 30
"""atheris keeps the result of every array comparison in memory, so a process must end soon."""


def main() -> int:
    """Return 0 if no target failed, 1 otherwise."""
    options = parser().parse_args()
    broken = [name for name in options.only if not _holds(name, options.seconds)]
    print(f"handled wrongly: {', '.join(broken) or 'none'}")
    return 1 if broken else 0


def parser() -> argparse.ArgumentParser:
    """The argument parser."""
    parser = argparse.ArgumentParser(prog="make fuzz", description="Fuzz all code that reads untrusted data.")
    some = f"some of: {', '.join(TARGETS)}"
    parser.add_argument("--only", nargs="+", choices=TARGETS, default=[*TARGETS], metavar="TARGET", help=some)
    parser.add_argument("--seconds", type=int, default=60, help="duration per target; default: %(default)s")
    return parser


def _holds(name: str, seconds: int) -> bool:
    """Search in one process after another; each continues with the inputs found so far."""
    print(f"{name} ...", flush=True)
    command = [sys.executable, "-m", "fuzz.search", name]
    durations_s = (min(seconds - begun_s, _PROCESS_S) for begun_s in range(0, seconds, _PROCESS_S))
    searches = ([*command, f"-max_total_time={duration_s}"] for duration_s in durations_s)
    return all(subprocess.run(search, check=False).returncode == 0 for search in searches)


if __name__ == "__main__":
    sys.exit(main())
