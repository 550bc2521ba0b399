"""Time of the forward pass of every model family in each runtime, compared with eager torch.

python -m benchmark.families [--quick] [--only NAME ...] [--size 640x480]
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmark.models import untrained_network
from benchmark.report import Goal, Row, goal_table, row, write_report
from benchmark.rounds import measure
from benchmark.task import Task
from benchmark.work import RUNTIME_PREFIX
from yolov5_lifecycle.checkpoints.yaml_architecture import architecture_of
from yolov5_lifecycle.models.architecture import Architecture
from yolov5_lifecycle.runtimes.registry import installed_runtimes

DATA = Path(__file__).parents[1] / "test" / "data" / "families.json"
REPORT = Path(__file__).parents[1] / "build" / "bench" / "families.json"
EAGER = "eager torch"
QUICK = ("yolov5n-act-SiLU", "v3.0/yolov5s", "yolov5s-ghost", "yolov5s-transformer", "yolov3-tiny", "zoo")


def families() -> Iterator[tuple[str, Architecture]]:
    """The architectures by name, without those that equal another one."""
    found: Mapping[str, Any] = json.loads(DATA.read_text())
    for name, described in found.items():
        if "same_numbers_as" not in described:
            yield name, _architecture(described)


def _architecture(described: Mapping[str, Any]) -> Architecture:
    architecture = architecture_of(
        described["yaml"],
        classes=described["yaml"]["nc"],
        anchors_px=tuple(tuple(map(tuple, level)) for level in described["anchors_px"]),
        strides=tuple(described["strides"]),
        image_channels=described["image_channels"],
    )
    others = tuple((path, activation) for path, activation in described.get("other_activations", []))
    return dataclasses.replace(architecture, activation=described["activation"], other_activations=others)


def measured(
    name: str, architecture: Architecture, image_hw: tuple[int, int], turns: int, folder: Path
) -> list[Row]:
    """A row for eager torch and for each runtime."""
    weights = str(untrained_network(architecture, folder / f"{name.replace('/', '-')}.safetensors"))
    runtimes = [f"{RUNTIME_PREFIX}{runtime}" for runtime in installed_runtimes()]
    tasks = [Task("rivals", EAGER, weights, image_hw)]
    tasks += [Task("work", runtime, weights, image_hw) for runtime in runtimes]
    taken_ms, _ = measure(tasks, loads=[0], turns=turns, cache=folder)
    return [row(name, task.name, 0, times_ms) for (task, _), times_ms in taken_ms.items()]


def line(rows: Sequence[Row]) -> str:
    """The medians of one family."""
    figures = "".join(f"{each.median:12.1f}" for each in rows)
    return f"{rows[0].what:28}{figures}{goal(rows).value:10.2f}"


def heading(rows: Sequence[Row]) -> str:
    """Header for the columns of `line`."""
    names = "".join(f"{each.name.removeprefix(RUNTIME_PREFIX):>12}" for each in rows)
    return f"{'median ms':28}{names}{'fastest /':>10} {EAGER}"


def goal(rows: Sequence[Row]) -> Goal:
    """Whether the fastest runtime takes no longer than eager torch."""
    (eager_ms,) = (each.median for each in rows if each.name == EAGER)
    fastest_ms = min(each.median for each in rows if each.name != EAGER)
    return Goal(f"{rows[0].what}: fastest runtime / {EAGER}", 0, fastest_ms / eager_ms, True, 1.0)


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="benchmark.families", description=__doc__)
    parser.add_argument("--only", nargs="*", default=[], metavar="NAME")
    parser.add_argument("--quick", action="store_true", help="six families, few rounds")
    parser.add_argument("--size", default="640x480", help="width x height of the image")
    arguments = parser.parse_args(argv)
    width, height = map(int, arguments.size.split("x"))
    chosen = arguments.only or (QUICK if arguments.quick else [name for name, _ in families()])
    rows: list[Row] = []
    goals: list[Goal] = []
    with tempfile.TemporaryDirectory() as folder:
        for name, architecture in families():
            if name in chosen:
                turns = 3 if arguments.quick else 6
                measurements = measured(name, architecture, (height, width), turns, Path(folder))
                if not rows:
                    print(heading(measurements))
                print(line(measurements), flush=True)
                rows += measurements
                goals.append(goal(measurements))
    print(
        goal_table(each for each in goals if not each.is_reached) or "No family is slower than eager torch."
    )
    write_report(REPORT, vars(arguments), rows, goals)
    return int(not all(each.is_reached for each in goals))


if __name__ == "__main__":
    sys.exit(main())
