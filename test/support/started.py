"""A process that ends with the block that started it."""

from __future__ import annotations

import subprocess
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
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
