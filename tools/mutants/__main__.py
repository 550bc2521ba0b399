"""Tries mutants, folder by folder: `make mutants MUTANTS_FLAGS=--help`."""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Collection, Mapping, Sequence
from contextlib import closing
from hashlib import sha256
from itertools import islice

from tools.mutants.folders import TESTS, mutants_of
from tools.mutants.known_survivors import LIST, differences, known_survivors
from tools.mutants.mutant import Mutant
from tools.mutants.trials import BrokenTestsError, Workers

MIN_SCORE = 0.9


def main() -> int:
    """Return 0 if enough mutants were killed and all others are listed, 1 otherwise."""
    options = parser().parse_args()
    existing = {folder: mutants_of(folder) for folder in TESTS}
    known = known_survivors(LIST.read_text())
    gone = differences(known, existing=_names(existing), tried=(), survived=())
    _tell(gone)
    tried, survived = list[Mutant](), list[Mutant]()
    print(f"{'folder':<16}{'mutants':>8}{'tried':>7}{'killed':>8}{'score':>8}{'s':>7}", flush=True)
    with closing(Workers(options.jobs)) as workers:
        for folder in options.only:
            try:
                sample = sampled(existing[folder], options.count, options.seed)
                alive = _survivors(workers, folder, sample, len(existing[folder]))
            except BrokenTestsError as error:
                print(error)
                return 1
            new = differences(known, existing=_names(existing), tried=_named(sample), survived=_named(alive))
            _tell({name: told for name, told in new.items() if name not in gone})
            tried += sample
            survived += alive
    score = 1 - len(survived) / max(1, len(tried))
    print(f"score {score:.1%} of {len(tried)} mutants, at least {MIN_SCORE:.0%} are needed")
    wrong = differences(known, existing=_names(existing), tried=_named(tried), survived=_named(survived))
    return 1 if wrong or score < MIN_SCORE else 0


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
    parser.add_argument("--count", type=int, default=30, help="mutants per folder; default: %(default)s")
    parser.add_argument(
        "--all", dest="count", action="store_const", const=sys.maxsize, help="every mutant: many hours"
    )
    parser.add_argument("--seed", type=int, default=0, help="another seed takes another sample")
    parser.add_argument(
        "--jobs", type=int, default=len(os.sched_getaffinity(0)), help="processes; default: one per core"
    )
    return parser


def sampled(mutants: Sequence[Mutant], count: int, seed: int) -> list[Mutant]:
    """`count` of `mutants`, the same ones while their names stay: other code of a folder may change."""
    ordered = sorted(mutants, key=lambda mutant: sha256(f"{seed} {mutant.name}".encode()).digest())
    return list(islice((mutant for mutant in ordered if mutant.is_python()), count))


def _survivors(workers: Workers, folder: str, sample: Sequence[Mutant], existing: int) -> list[Mutant]:
    begun_s = time.monotonic()
    alive = workers.survivors(sample, workers.baselines(folder))
    killed, taken_s = len(sample) - len(alive), time.monotonic() - begun_s
    score = killed / max(1, len(sample))
    print(f"{folder:<16}{existing:>8}{len(sample):>7}{killed:>8}{score:>8.1%}{taken_s:>7.0f}", flush=True)
    return alive


def _names(existing: Mapping[str, Sequence[Mutant]]) -> set[str]:
    return {mutant.name for mutants in existing.values() for mutant in mutants}


def _named(mutants: Sequence[Mutant]) -> Collection[str]:
    return {mutant.name for mutant in mutants}


def _tell(wrong: Mapping[str, str]) -> None:
    for name, told in wrong.items():
        print(f"  {name}\n    {told}", flush=True)


if __name__ == "__main__":
    sys.exit(main())
