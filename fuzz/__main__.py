"""Fuzzes each target in its own process: `make fuzz FUZZ_FLAGS=--help`."""

from __future__ import annotations

import argparse
import subprocess
import sys

from fuzz.targets import TARGETS


def main() -> int:
    """Return 0 if no target failed, 1 otherwise."""
    options = parser().parse_args()
    broken = [name for name in options.only if not _holds(name, options.seconds)]
    print(f"handled wrongly: {', '.join(broken) or 'none'}")
    return 1 if broken else 0


def parser() -> argparse.ArgumentParser:
    """The argument parser."""
    parser = argparse.ArgumentParser(prog="make fuzz", description="Fuzz the parsers of untrusted bytes.")
    parser.add_argument(
        "--only",
        nargs="+",
        choices=TARGETS,
        default=[*TARGETS],
        metavar="TARGET",
        help=f"some of: {', '.join(TARGETS)}",
    )
    parser.add_argument("--seconds", type=int, default=60, help="for each target; default: %(default)s")
    return parser


def _holds(name: str, seconds: int) -> bool:
    print(f"{name} ...", flush=True)
    command = [sys.executable, "-m", "fuzz.search", name, f"-max_total_time={seconds}"]
    return subprocess.run(command, check=False).returncode == 0


if __name__ == "__main__":
    sys.exit(main())
