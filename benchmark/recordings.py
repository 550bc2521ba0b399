"""Time for many recordings: workers of `detect_bag` compared with single runs.

PYTHONPATH=test python -m benchmark.recordings [--weights FILE] [--recordings N] [--images N] [--rounds N]
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import count
from pathlib import Path

from rosbags.rosbag2 import StoragePlugin
from support.recorded_scene import raw, record

from benchmark.models import untrained_weights
from benchmark.report import Figures, Goal, Program, in_turns, median_ratio, quick, row, timed

SINGLE, ONE, ONE_CORE, TWO = "single runs", "one worker", "one worker, one core", "two workers"
_FRAMES = 20
_MAX_OVERHEAD = 1.05
_MIN_GAIN = 1.6

Run = Callable[[], object]


def calls(drives: Path, weights: Path, folder: Path) -> Mapping[str, Run]:
    """What is measured, by name: commands as a user types them, each with new outputs in `folder`."""
    number = count()
    words = ["--set", f"weights={weights}", "--set", "device=cpu"]
    sources = [str(path) for path in sorted(drives.iterdir())]

    def single() -> None:
        for source in sources:
            _detect_bag(folder, source, "--output", str(folder / f"found-{next(number)}"), *words)

    def many(jobs: int, **environment: str) -> Run:
        def run() -> None:
            output = str(folder / f"found-{next(number)}")
            _detect_bag(folder, *sources, "--output", output, "--jobs", str(jobs), *words, **environment)

        return run

    return {
        SINGLE: single,
        ONE: many(1),
        ONE_CORE: many(1, OMP_NUM_THREADS="1"),
        TWO: many(2, OMP_NUM_THREADS="1"),
    }


def _detect_bag(cache: Path, *words: str, **environment: str) -> None:
    command = Path(sys.executable).with_name("detect_bag")
    variables = os.environ | {"XDG_CACHE_HOME": str(cache / "cache")} | environment
    subprocess.run([command, *words], env=variables, check=True, stderr=subprocess.DEVNULL)


def goals(taken_s: Mapping[str, Sequence[float]]) -> list[Goal]:
    """Medians of the ratios within each round."""
    return [
        Goal(f"{ONE} / {SINGLE}", 0, median_ratio(taken_s[ONE], taken_s[SINGLE]), True, _MAX_OVERHEAD),
        Goal(f"{ONE_CORE} / {TWO}", 0, median_ratio(taken_s[ONE_CORE], taken_s[TWO]), False, _MIN_GAIN),
        Goal(f"{ONE} on all cores / {TWO}", 0, median_ratio(taken_s[ONE], taken_s[TWO]), False, 1.0),
    ]


def measured(options: argparse.Namespace, folder: Path) -> Figures:
    """All ways in each round."""
    (folder / "drives").mkdir()
    frames = [raw(number) for number in range(_FRAMES)]
    images = [frames[number % _FRAMES] for number in range(30 if options.quick else options.images)]
    for number in range(options.recordings):
        record(folder / "drives" / f"drive_{number}", images, storage=StoragePlugin.MCAP)
    weights = options.weights or untrained_weights("n", folder)
    runs = calls(folder / "drives", weights.absolute(), folder)
    rounds = 1 if options.quick else options.rounds
    # The first turn measures the runtimes.
    taken_s = in_turns({name: partial(timed, run) for name, run in runs.items()}, rounds, warm_ups=1)
    rows = [row("many recordings", name, 0, times_s, unit="s") for name, times_s in taken_s.items()]
    return rows, goals(taken_s)


PROGRAM = Program(
    "recordings",
    __doc__,
    measured,
    {
        "--quick": quick("one round, 30 images of each"),
        "--weights": {"type": Path, "help": "if not an untrained yolov5n"},
        "--recordings": {"type": int, "default": 4, "help": "their number"},
        "--images": {"type": int, "default": 150, "help": "of each recording"},
        "--rounds": {"type": int, "default": 3, "help": "of all ways"},
    },
)


if __name__ == "__main__":
    sys.exit(PROGRAM.main())
