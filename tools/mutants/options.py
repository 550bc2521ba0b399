"""What `make mutants` may be asked for."""

from __future__ import annotations

import argparse
import os
import sys

from tools.mutants.folders import TESTS


def parser() -> argparse.ArgumentParser:
    """The argument parser."""
    parser = argparse.ArgumentParser(
        prog="make mutants", description="Change the code in small ways; a test must notice each."
    )
    parser.add_argument(
        "--only",
        nargs="+",
        choices=TESTS,
        default=[*TESTS],
        metavar="FOLDER",
        help=f"some of: {', '.join(TESTS)}",
    )
    parser.add_argument("--count", type=int, default=40, help="mutants per folder; default: %(default)s")
    parser.add_argument(
        "--all", dest="count", action="store_const", const=sys.maxsize, help="every mutant: many hours"
    )
    parser.add_argument("--seed", type=int, default=0, help="another seed takes another sample")
    parser.add_argument(
        "--jobs", type=int, default=len(os.sched_getaffinity(0)), help="processes; default: one per core"
    )
    return parser
