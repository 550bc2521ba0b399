"""Measure how well and how fast objects are tracked."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from benchmark.report import Figures, Goal, Program
from benchmark.tracking.cases import Case, counts_of, oracle_ids, own_ids, rendered_cases, simulated_cases
from benchmark.tracking.figures import TrackCounts
from benchmark.tracking.scenes import STILL_SCENES
from benchmark.tracking.times import time_rows

MIN_GAIN = 0.08
"""Of the mean IDF1 over all scenes and rates, above that of the oracle."""
MAX_LOSS = 0.01
"""Of IDF1 in any scene at any rate, below that of the oracle."""
MAX_STILL_LOSS = 0.002
"""Of the mean IDF1 where the camera stands still, through looking for its motion in the images."""
TUNING_SEED = 100
"""The constants of the tracker were chosen with seeds from here on; judged are those from 0 on."""
Group = tuple[str, float]
"""A scene at a rate."""


def identity_table(cases: Sequence[Case], counts: Mapping[str, Sequence[TrackCounts]]) -> str:
    """A line for each scene and rate: IDF1 and switches of each tracker.

    `counts` has those of every case for each tracker. The last line has the means of all lines.
    """
    heads = f"{'scene':13}{'Hz':>4}{'objects':>9}" + "".join(f"  {name:>8}: IDF1 switches" for name in counts)
    lines = [heads, "-" * len(heads)]
    sums = {name: _groups(cases, each) for name, each in counts.items()}
    for group, truths in ((group, each.truths) for group, each in next(iter(sums.values())).items()):
        figures = "".join(_figures([each[group]]) for each in sums.values())
        lines.append(f"{group[0]:13}{group[1]:>4g}{truths:9}{figures}")
    means = "".join(_figures(list(each.values())) for each in sums.values())
    return "\n".join([*lines, f"{'mean':13}{'':>4}{'':9}{means}"])


def _figures(counts: Sequence[TrackCounts]) -> str:
    """The mean of IDF1, and all switches."""
    idf1 = sum(c.idf1 for c in counts) / len(counts)
    return f"{idf1:16.3f}{sum(c.switches for c in counts):9}"


def _groups(cases: Sequence[Case], counts: Sequence[TrackCounts]) -> dict[Group, TrackCounts]:
    """The sum of the counts of each scene and rate."""
    groups = dict.fromkeys(((case.name, case.rate_hz) for case in cases), TrackCounts())
    for case, each in zip(cases, counts, strict=True):
        groups[case.name, case.rate_hz] += each
    return groups


def identity_goals(
    what: str, cases: Sequence[Case], counts: Mapping[str, Sequence[TrackCounts]]
) -> Iterator[Goal]:
    """Of the IDF1 with and without images, compared with the oracle and with each other."""
    idf1 = {name: {g: c.idf1 for g, c in _groups(cases, each).items()} for name, each in counts.items()}
    oracle = idf1.pop("oracle", {})
    if oracle:
        gains = [own - oracle[group] for group, own in idf1["own"].items()]
        mean = sum(gains) / len(gains)
        yield Goal(f"IDF1 less the oracle's, {what}, mean", 0, mean, False, MIN_GAIN)
        yield Goal(f"IDF1 less the oracle's, {what}, worst scene", 0, min(gains), False, -MAX_LOSS)
    losses = [idf1["boxes"][group] - own for group, own in idf1["own"].items() if group[0] in STILL_SCENES]
    if losses:
        mean = sum(losses) / len(losses)
        yield Goal(f"IDF1 lost through images, {what}, camera still", 0, mean, True, MAX_STILL_LOSS)


def measured(options: argparse.Namespace, _: Path) -> Figures:
    """Identities in all scenes, printed as a table, then times."""
    goals: list[Goal] = []
    makers = [("simulated", simulated_cases, options.seeds), ("rendered", rendered_cases, options.rendered)]
    for what, make_cases, seeds in makers:
        if not seeds:
            continue
        cases = make_cases(range(options.first_seed, options.first_seed + seeds))
        counts = {
            "own": [counts_of(case.frames, own_ids(case.frames)) for case in cases],
            "boxes": [counts_of(case.frames, own_ids(case.frames, with_camera=False)) for case in cases],
        }
        if options.oracle:
            answers = oracle_ids(options.oracle, cases)
            counts["oracle"] = [counts_of(case.frames, ids) for case, ids in zip(cases, answers, strict=True)]
        print(f"{what}\n{identity_table(cases, counts)}\n")
        goals += identity_goals(what, cases, counts)
    rows = time_rows()
    goals.append(Goal("50 objects [ms]", 0, rows[0].median, True, 1.0))
    goals += [Goal(f"camera motion, {each.name} [ms]", 0, each.median, True, 1.5) for each in rows[3:]]
    return rows, goals


_CHOSEN = f"of the scenes; the constants were chosen with {TUNING_SEED} and later"
PROGRAM = Program(
    "tracking",
    __doc__,
    measured,
    {
        "--seeds": {"type": int, "default": 5, "help": "scenes of each kind"},
        "--first-seed": {"type": int, "default": 0, "help": _CHOSEN},
        "--rendered": {"type": int, "default": 0, "help": "the same, in drawn images"},
        "--oracle": {"type": Path, "metavar": "PYTHON", "help": "interpreter that has `trackers`"},
    },
    is_judged=True,
)
parser = PROGRAM.parser


if __name__ == "__main__":
    sys.exit(PROGRAM.main())
