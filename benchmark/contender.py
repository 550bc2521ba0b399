"""Processes that each run one task on request and report how long it takes, measured alternately.

Each contender has its own process, because thread waiting policies are fixed once per process.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

from benchmark.process_memory import peak_resident_mb
from benchmark.report import in_turns, timed
from yolov5_lifecycle.process.environment import WAITING, prepare_environment

_WARM_UPS = 3
_IN_A_ROW = 3
_PAUSE_S = 0.02  # for threads that still spin after their last round


@dataclass(frozen=True)
class Task:
    """`name`, as defined by the module `side`, for a file of `weights` and an image of `image_hw`."""

    side: Literal["rivals", "work"]
    name: str
    weights: str
    image_hw: tuple[int, int]


@dataclass(frozen=True)
class Contender:
    """A process that runs `task`."""

    task: Task
    process: subprocess.Popen[str]

    def measure(self, times: int = _IN_A_ROW) -> list[float]:
        """Milliseconds of each time; raises RuntimeError if the process failed."""
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        time.sleep(_PAUSE_S)
        self.process.stdin.write(f"{times}\n")
        self.process.stdin.flush()
        answer = self.process.stdout.readline()
        if not answer:
            raise RuntimeError(f"'{self.task.name}' failed; its output is above")
        times_ms: list[float] = json.loads(answer)
        return times_ms


def measure(
    tasks: Iterable[Task], *, loads: Iterable[int], turns: int, cache: Path
) -> tuple[Mapping[tuple[Task, int], list[float]], Mapping[Task, float]]:
    """Milliseconds of each task next to each number of busy processes, and the peak memory in MB.

    A rival that does not run here is reported and skipped.
    """
    environment = os.environ | {"XDG_CACHE_HOME": str(cache)}
    with ExitStack() as stack:
        contenders = [each for task in tasks if (each := _begun(task, environment, stack))]
        taken_ms: dict[tuple[Task, int], list[float]] = {}
        for busy in loads:
            with busy_processes(busy):
                for each, times_ms in in_turns({each: each.measure for each in contenders}, turns).items():
                    taken_ms[each.task, busy] = [time_ms for turn in times_ms for time_ms in turn]
        return taken_ms, {each.task: peak_resident_mb(each.process.pid) for each in contenders}


def _begun(task: Task, environment: Mapping[str, str], stack: ExitStack) -> Contender | None:
    try:
        return stack.enter_context(contender(task, environment))
    except RuntimeError as error:
        if task.side != "rivals":
            raise
        print(f"left out: {error}", file=sys.stderr)
        return None


@contextmanager
def contender(task: Task, environment: Mapping[str, str]) -> Iterator[Contender]:
    """A warmed-up process for `task`."""
    command = [sys.executable, "-m", "benchmark.contender", json.dumps(asdict(task))]
    if task.side == "rivals":
        environment = {name: value for name, value in environment.items() if name not in WAITING}
    process = subprocess.Popen(
        command,
        env=environment,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        cwd=Path(__file__).parents[1],
    )
    try:
        made = Contender(task, process)
        made.measure(_WARM_UPS)
        yield made
    finally:
        process.kill()
        process.communicate()


@contextmanager
def busy_processes(count: int) -> Iterator[None]:
    """Processes that each keep one core busy, as on a robot."""
    processes = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(count)]
    try:
        yield
    finally:
        for process in processes:
            process.kill()
            process.wait()


def _call_of(task: Task) -> Callable[[], object]:
    # Import only one of the two: they need torch with and without the package's environment variables.
    if task.side == "rivals":
        from benchmark.rivals import call_of
    else:
        prepare_environment()
        from benchmark.work import call_of
    return call_of(task)


def _serve() -> None:
    fields = json.loads(sys.argv[1])
    call = _call_of(Task(**fields | {"image_hw": tuple(fields["image_hw"])}))
    for line in sys.stdin:
        print(json.dumps([1e3 * timed(call) for _ in range(int(line))]), flush=True)


if __name__ == "__main__":
    _serve()
    os._exit(0)
