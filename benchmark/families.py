"""Time of the forward pass of every model family in each runtime, compared with eager torch.

PYTHONPATH=test python -m benchmark.families [--quick] [--only NAME ...] [--size 640x480]
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from support.formula_model import families, family_architecture

from benchmark.contender import Task, measure
from benchmark.models import untrained_network
from benchmark.report import Figures, Goal, Program, Row, quick, row, size_hw
from benchmark.work import RUNTIME_PREFIX
from yolov5_lifecycle.models.architecture import Architecture
from yolov5_lifecycle.runtimes.registry import installed_runtimes

EAGER = "eager torch"
QUICK = ("yolov5n-act-SiLU", "v3.0/yolov5s", "yolov5s-ghost", "yolov5s-transformer", "yolov3-tiny", "zoo")


def family(
    name: str, architecture: Architecture, image_hw: tuple[int, int], turns: int, folder: Path
) -> list[Row]:
    """A row for eager torch and for each runtime."""
    weights = str(untrained_network(architecture, folder / f"{name.replace('/', '-')}.safetensors"))
    runtimes = [f"{RUNTIME_PREFIX}{runtime}" for runtime in installed_runtimes()]
    tasks = [Task("rivals", EAGER, weights, image_hw)]
    tasks += [Task("work", runtime, weights, image_hw) for runtime in runtimes]
    taken_ms, _ = measure(tasks, loads=[0], turns=turns, cache=folder)
    return [row(name, task.name, 0, times_ms) for (task, _), times_ms in taken_ms.items()]


def goal(rows: Sequence[Row]) -> Goal:
    """Whether the fastest runtime takes no longer than eager torch."""
    (eager_ms,) = (each.median for each in rows if each.name == EAGER)
    fastest_ms = min(each.median for each in rows if each.name != EAGER)
    return Goal(f"{rows[0].what}: fastest runtime / {EAGER}", 0, fastest_ms / eager_ms, True, 1.0)


def measured(options: argparse.Namespace, folder: Path) -> Figures:
    """The chosen families."""
    every = [name for name, described in families().items() if "same_numbers_as" not in described]
    chosen = options.only or (QUICK if options.quick else every)
    turns = 3 if options.quick else 6
    rows: list[Row] = []
    goals: list[Goal] = []
    for name in chosen:
        print(f"measuring: {name}", flush=True)
        of_family = family(name, family_architecture(name), options.size, turns, folder)
        rows += of_family
        goals.append(goal(of_family))
    return rows, goals


PROGRAM = Program(
    "families",
    __doc__,
    measured,
    {
        "--quick": quick("six families, few rounds"),
        "--only": {"nargs": "*", "default": [], "metavar": "NAME", "help": "some families"},
        "--size": {"type": size_hw, "default": "640x480", "help": "width x height of the image"},
    },
    is_judged=True,
)


if __name__ == "__main__":
    sys.exit(PROGRAM.main())
