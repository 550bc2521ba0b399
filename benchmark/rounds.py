"""Contenders measured alternately, so that noise of the machine affects all alike."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Iterable, Mapping
from contextlib import ExitStack
from pathlib import Path

from benchmark.contender import Contender, contender
from benchmark.neighbours import busy_neighbours
from benchmark.task import Task

_IN_A_ROW = 3
_PAUSE_S = 0.02  # for threads that still spin after their last round


def measure(
    tasks: Iterable[Task], *, loads: Iterable[int], turns: int, cache: Path
) -> tuple[Mapping[tuple[Task, int], list[float]], Mapping[Task, float]]:
    """Milliseconds of each task next to each number of busy neighbours, and the peak memory in MB.

    A rival that does not run here is reported and skipped.
    """
    environment = os.environ | {"XDG_CACHE_HOME": str(cache)}
    with ExitStack() as stack:
        begun = [_begun(task, environment, stack) for task in tasks]
        contenders = [each for each in begun if each is not None]
        taken_ms: dict[tuple[Task, int], list[float]] = {}
        for busy in loads:
            with busy_neighbours(busy):
                for _ in range(turns):
                    for each in contenders:
                        time.sleep(_PAUSE_S)
                        taken_ms.setdefault((each.task, busy), []).extend(each.measure(_IN_A_ROW))
        return taken_ms, {each.task: each.peak_resident_mb for each in contenders}


def _begun(task: Task, environment: Mapping[str, str], stack: ExitStack) -> Contender | None:
    try:
        return stack.enter_context(contender(task, environment))
    except RuntimeError as error:
        if task.side != "rivals":
            raise
        print(f"left out: {error}", file=sys.stderr)
        return None
