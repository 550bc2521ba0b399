"""Processes that end with the block that started them, and what programs print."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any


@contextmanager
def started(words: Sequence[object], **options: Any) -> Iterator[subprocess.Popen[Any]]:
    """`Popen(words, **options)`, killed at the end, also of a failed test.

    Popen itself as a context manager waits without a limit for a process that nobody ends.
    """
    with subprocess.Popen(list(map(str, words)), **options) as process:
        try:
            yield process
        finally:
            process.kill()


def printed_by(program: str, *, cwd: Path | None = None, variables: Mapping[str, str] = {}) -> str:
    """What a new Python prints that runs `program` to its end, with more environment `variables`."""
    run = subprocess.run(
        [sys.executable, "-c", program], cwd=cwd, env=os.environ | variables, capture_output=True, text=True
    )
    assert run.returncode == 0, run.stderr
    return run.stdout
