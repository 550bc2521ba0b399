"""Atomic file output: a file is either complete or absent."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path

from yolov5_lifecycle.unfinished import hold, remove_abandoned_folders, temporary_folder

UNFINISHED_PREFIX, UNFINISHED_SUFFIX = ".", ".part"
_ATTEMPTS = 20


def atomic_write(path: Path, *parts: bytes, is_durable: bool = True) -> None:
    """Atomically replace the file at `path` with the concatenated `parts`; readable by all users.

    If not `is_durable`, a power failure may leave a damaged file. A killed process leaves a file `.*.part`
    next to it, which is locked while the process lives. Raises OSError.
    """
    with _written(path.parent, parts, is_durable=is_durable) as unfinished:
        unfinished.replace(path)


def write_together(contents: Mapping[Path, bytes]) -> None:
    """Like `atomic_write` for each path, in order, after all of them have been written. Raises OSError."""
    with ExitStack() as stack:
        unfinished = {
            path: stack.enter_context(_written(path.parent, [content], is_durable=True))
            for path, content in contents.items()
        }
        for path, file in unfinished.items():
            file.replace(path)


@contextmanager
def _written(folder: Path, parts: Iterable[bytes], *, is_durable: bool) -> Iterator[Path]:
    """A locked file in `folder` with `parts` in it; removed on exit unless it was renamed."""
    descriptor, unfinished = _new_file(folder)
    try:
        with os.fdopen(descriptor, "wb") as file:
            file.writelines(parts)
            file.flush()
            if is_durable:
                os.fsync(descriptor)
            os.fchmod(descriptor, 0o644)
            yield unfinished  # to be renamed before closing the descriptor releases the lock
    finally:
        unfinished.unlink(missing_ok=True)


def _new_file(folder: Path) -> tuple[int, Path]:
    """A locked file with a new name in `folder`."""
    for _ in range(_ATTEMPTS):
        descriptor, name = tempfile.mkstemp(dir=folder, prefix=UNFINISHED_PREFIX, suffix=UNFINISHED_SUFFIX)
        if hold(descriptor, Path(name)):
            return descriptor, Path(name)
        os.close(descriptor)
        Path(name).unlink(missing_ok=True)
    raise FileNotFoundError(f"Other processes keep removing new files from {folder}.")


class OutputError(ValueError):
    """Output that cannot be written to the requested path; the message has the cause and a remedy."""


@contextmanager
def whole_output(path: Path) -> Iterator[Path]:
    """Temporary path for a file or folder, which is renamed to `path` when the block succeeds.

    Until then, and on failure, nothing exists at `path`. A killed process leaves a hidden folder next to it,
    which the next output to the same folder removes. Raises OutputError if `path` already exists, and
    OSError.
    """
    _check_free(path)
    if not path.parent.is_dir():
        raise OutputError(f"{path.parent}: folder not found; create it first.")
    remove_abandoned_folders(path.parent)
    with temporary_folder(path.parent) as folder:
        unfinished = folder / path.name
        yield unfinished
        _check_free(path)
        unfinished.rename(path)


def _check_free(path: Path) -> None:
    if os.path.lexists(path):
        raise OutputError(f"{path} exists and is not replaced: choose another name or remove it.")
