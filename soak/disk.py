"""A disk that becomes full, read-only or unplugged."""

from __future__ import annotations

import os
import subprocess
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import TracebackType

_REFILL_S = 0.01


class Disk:
    """A disk of `megabytes` in memory, mounted at `path` while it is plugged in; a context manager.

    `is_real`: False if this process may not mount anything, as usual without root: `path` is then a folder.
    """

    def __init__(self, megabytes: int) -> None:
        self._temporary = tempfile.TemporaryDirectory()
        self._hidden = Path(self._temporary.name, "hidden")
        self._size = f"size={megabytes}m"
        self.path = Path(self._temporary.name, "disk")
        self.is_real = False

    def __enter__(self) -> Disk:
        for folder in (self._hidden, self.path):
            folder.mkdir()
        with suppress(OSError, subprocess.CalledProcessError):
            # What is mounted twice keeps its content when it is unmounted once.
            _run("mount", "-t", "tmpfs", "-o", self._size, "tmpfs", os.fspath(self._hidden))
            self.is_real = True
            self._plug()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: object, trace: TracebackType | None) -> None:
        for path in (self.path, self._hidden):
            while os.path.ismount(path):
                _run("umount", "--lazy", os.fspath(path))
        self._temporary.cleanup()

    @contextmanager
    def unplugged(self) -> Iterator[None]:
        """It is unmounted, whoever has files open on it."""
        _run("umount", "--lazy", os.fspath(self.path))
        try:
            yield
        finally:
            self._plug()

    @contextmanager
    def protected(self) -> Iterator[None]:
        """It is read-only."""
        _run("mount", "-o", "remount,bind,ro", os.fspath(self.path))
        try:
            yield
        finally:
            _run("mount", "-o", "remount,bind,rw", os.fspath(self.path))

    @contextmanager
    def full(self) -> Iterator[None]:
        """All of its space is used, also what others free meanwhile."""
        filling, is_over = self.path / "filling", threading.Event()
        thread = threading.Thread(target=_fill, args=(filling, is_over))
        thread.start()
        try:
            yield
        finally:
            is_over.set()
            thread.join()
            filling.unlink()

    def _plug(self) -> None:
        _run("mount", "--bind", os.fspath(self._hidden), os.fspath(self.path))


def _run(*command: str) -> None:
    subprocess.run(command, check=True, capture_output=True)


def _fill(path: Path, is_over: threading.Event) -> None:
    with path.open("wb", buffering=0) as file:
        while not is_over.wait(_REFILL_S):
            with suppress(OSError):
                while file.write(bytes(1 << 12)):
                    pass
