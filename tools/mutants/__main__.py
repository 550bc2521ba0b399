"""Tries mutants, folder by folder: `make mutants MUTANTS_FLAGS=--help`."""

from __future__ import annotations

import sys
import time
from collections.abc import Collection, Mapping, Sequence
from contextlib import closing

from tools.mutants.folders import TESTS
from tools.mutants.known_survivors import LIST, differences, known_survivors
from tools.mutants.mutant import Mutant, mutants_of, sampled
from tools.mutants.options import parser
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
