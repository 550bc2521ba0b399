"""A process that runs one task on request and reports its duration.

Each contender has its own process, because thread waiting policies are fixed once per process.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path

from benchmark.process_memory import peak_resident_mb
from benchmark.task import Task
from yolov5_lifecycle.process.environment import WAITING, prepare_environment

_WARM_UPS = 3


@dataclass(frozen=True)
class Contender:
    """A process that runs `task`."""

    task: Task
    process: subprocess.Popen[str]

    def measure(self, rounds: int) -> list[float]:
        """Milliseconds of each round; raises RuntimeError if the process failed."""
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.write(f"{rounds}\n")
        self.process.stdin.flush()
        answer = self.process.stdout.readline()
        if not answer:
            raise RuntimeError(f"'{self.task.name}' failed; its output is above")
        times_ms: list[float] = json.loads(answer)
        return times_ms

    @property
    def peak_resident_mb(self) -> float:
        """Peak resident memory of the process."""
        return peak_resident_mb(self.process.pid)


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
        times_ms = []
        for _ in range(int(line)):
            begun_s = time.perf_counter()
            call()
            times_ms.append(1e3 * (time.perf_counter() - begun_s))
        print(json.dumps(times_ms), flush=True)


if __name__ == "__main__":
    _serve()
    os._exit(0)
