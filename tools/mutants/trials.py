"""Tries mutants: each worker has a copy of the repository, changes one module of it and runs the tests."""

from __future__ import annotations

import json
import os
import queue
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.util import cache_from_source
from pathlib import Path
from typing import Any, TypeVar

from tools.mutants.folders import PACKAGE, REPOSITORY, files_of_tests
from tools.mutants.mutant import Mutant
from tools.mutants.worker import LOG
from yolov5_lifecycle.process.environment import prepare_environment

COPIES = REPOSITORY / "build" / "mutants"
LEFT_OUT = shutil.ignore_patterns(
    ".git", ".venv*", "build", "install", "log", "node_modules", ".*_cache", "__pycache__"
)
BASELINE_LIMIT_S = 600.0
SPARE_S = 20.0
SLOWDOWN = 4.0
"""A mutant is killed by time after SPARE_S and SLOWDOWN times what its tests take without it."""
Asked = TypeVar("Asked")
Answered = TypeVar("Answered")


class BrokenTestsError(Exception):
    """Tests fail without a mutant."""


@dataclass(frozen=True)
class Baseline:
    """Lines by module of the package that one file of tests executes without mutants."""

    tests: str
    lines: Mapping[str, frozenset[int]]
    taken_s: float

    def reaches(self, mutant: Mutant) -> bool:
        """Whether a line of the function, or outside of functions any line of the module, is executed."""
        lines = self.lines.get(mutant.module, frozenset())
        if not mutant.last_line:
            return bool(lines)
        return any(mutant.first_line <= line <= mutant.last_line for line in lines)


class Worker:
    """Owns a copy of the repository and the process that runs tests in it."""

    def __init__(self, number: int) -> None:
        self._copy = COPIES / str(number)
        shutil.rmtree(self._copy, ignore_errors=True)
        shutil.copytree(REPOSITORY, self._copy, ignore=LEFT_OUT, symlinks=True)
        (self._copy / ".venv").symlink_to(Path(sys.prefix))
        self._process = subprocess.Popen(
            [sys.executable, "-m", "tools.mutants.worker"],
            cwd=self._copy,
            env=os.environ | {"PYTHONPATH": str(self._copy), "OMP_NUM_THREADS": "1"},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def baseline(self, folder: str, tests: str) -> Baseline:
        """What the tests execute in `folder`. Raises BrokenTestsError when they fail."""
        answer = self._ask([tests], f"{PACKAGE}/{folder}", BASELINE_LIMIT_S)
        if answer["code"] not in (0, 5):  # 5: all of its tests are long
            log = (self._copy / LOG).read_text()
            raise BrokenTestsError(f"{tests} fails without a mutant:\n{log[-4000:]}")
        root = self._copy / PACKAGE
        lines = {
            str(Path(file).relative_to(root)): frozenset(found) for file, found in answer["lines"].items()
        }
        return Baseline(tests, lines, answer["taken_s"])

    def is_killed(self, mutant: Mutant, baselines: Iterable[Baseline]) -> bool:
        """Whether a test that reaches the mutant fails, or takes too long."""
        everything = sorted(baselines, key=lambda each: each.taken_s)
        chosen = [each for each in everything if each.reaches(mutant)] or everything
        limit_s = SPARE_S + SLOWDOWN * sum(each.taken_s for each in chosen)
        with self._changed(mutant):
            return bool(self._ask([each.tests for each in chosen], "", limit_s)["code"])

    @contextmanager
    def _changed(self, mutant: Mutant) -> Iterator[None]:
        file = self._copy / PACKAGE / mutant.module
        before, cached = file.read_text(), Path(cache_from_source(str(file)))
        try:
            file.write_text(mutant.code())
            cached.unlink(missing_ok=True)
            yield
        finally:
            file.write_text(before)
            cached.unlink(missing_ok=True)

    def _ask(self, tests: list[str], measured: str, limit_s: float) -> dict[str, Any]:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(
            json.dumps({"tests": tests, "measured": measured, "limit_s": limit_s}) + "\n"
        )
        self._process.stdin.flush()
        return dict(json.loads(self._process.stdout.readline()))

    def close(self) -> None:
        """End the process and remove the copy."""
        self._process.communicate()
        shutil.rmtree(self._copy, ignore_errors=True)


class Workers:
    """Owns `count` workers, which try mutants at the same time."""

    def __init__(self, count: int) -> None:
        prepare_environment()  # as the commands do; the workers import numpy before the tests could
        self._workers = [Worker(number) for number in range(count)]
        self._free = queue.SimpleQueue[Worker]()
        for worker in self._workers:
            self._free.put(worker)

    def baselines(self, folder: str) -> list[Baseline]:
        """Of each file of tests for `folder`. Raises BrokenTestsError when one fails."""
        return list(self._each(lambda worker, tests: worker.baseline(folder, tests), files_of_tests(folder)))

    def survivors(self, mutants: Sequence[Mutant], baselines: Sequence[Baseline]) -> list[Mutant]:
        """Those of `mutants` that no test notices."""
        killed = self._each(lambda worker, mutant: worker.is_killed(mutant, baselines), mutants)
        return [mutant for mutant, is_killed in zip(mutants, killed, strict=True) if not is_killed]

    def _each(
        self, answer: Callable[[Worker, Asked], Answered], questions: Sequence[Asked]
    ) -> Iterator[Answered]:
        def answered(question: Asked) -> Answered:
            worker = self._free.get()
            try:
                return answer(worker, question)
            finally:
                self._free.put(worker)

        with ThreadPoolExecutor(len(self._workers)) as threads:
            yield from threads.map(answered, questions)

    def close(self) -> None:
        """Close all workers."""
        for worker in self._workers:
            worker.close()
