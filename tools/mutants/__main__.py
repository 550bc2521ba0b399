"""Tries mutants, folder by folder: `make mutants MUTANTS_FLAGS=--help`."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from contextlib import closing

from tools.mutants.folders import parser
from tools.mutants.mutant import Mutant, mutants_of, sampled
from tools.mutants.trials import BrokenTestsError, Workers

MIN_SCORE = 0.92


def main() -> int:
    """Return 0 if enough mutants were killed, 1 otherwise."""
    options = parser().parse_args()
    tried = survived = 0
    print(f"{'folder':<16}{'mutants':>8}{'tried':>7}{'killed':>8}{'score':>8}{'s':>7}", flush=True)
    with closing(Workers(options.jobs)) as workers:
        for folder in options.only:
            existing = mutants_of(folder)
            sample = sampled(existing, options.count, options.seed)
            try:
                survived += len(_survivors(workers, folder, sample, len(existing)))
            except BrokenTestsError as error:
                print(error)
                return 1
            tried += len(sample)
    score = 1 - survived / max(1, tried)
    print(f"score {score:.1%} of {tried} mutants, at least {MIN_SCORE:.0%} are needed")
    return 1 if score < MIN_SCORE else 0


def _survivors(workers: Workers, folder: str, sample: Sequence[Mutant], existing: int) -> list[Mutant]:
    begun_s = time.monotonic()
    alive = workers.survivors(sample, workers.baselines(folder))
    killed, taken_s = len(sample) - len(alive), time.monotonic() - begun_s
    score = killed / max(1, len(sample))
    print(f"{folder:<16}{existing:>8}{len(sample):>7}{killed:>8}{score:>8.1%}{taken_s:>7.0f}", flush=True)
    for mutant in alive:
        print(f"  {mutant.name}", flush=True)
    return alive


if __name__ == "__main__":
    sys.exit(main())
