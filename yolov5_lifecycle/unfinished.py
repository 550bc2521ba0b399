"""Unfinished files and folders: locked by the process that creates them, removable once it is dead.

The lock is flock(2). The kernel releases it when the process ends for any reason, so neither a stale file nor
a reused process id can be mistaken for a living owner.
"""

from __future__ import annotations

import fcntl
import os
import shutil
import stat
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

FOLDER_PREFIX = ".yolov5_lifecycle-unfinished-"
"""No other folder has such a name: one that is abandoned is removed with all that is in it."""
_ATTEMPTS = 20


def hold(descriptor: int, path: Path) -> bool:
    """Lock the file or folder `path`, open as `descriptor`, until the descriptor is closed.

    Returns False if another process has locked or removed it. On a file system without locks, returns True:
    `remove_abandoned` needs the lock, so it removes nothing there. Raises OSError.
    """
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        return True
    try:
        return os.path.samestat(os.fstat(descriptor), os.lstat(path))
    except FileNotFoundError:
        return False


def open_itself(path: str | Path, flags: int = os.O_RDONLY) -> int:
    """Open `path` itself, without following a link or blocking on a pipe; usable as an `opener` of `open`.

    Raises OSError, with ELOOP for a link and ENXIO for a pipe without a reader.
    """
    return os.open(path, flags | os.O_NOFOLLOW | os.O_NONBLOCK, 0o644)


@contextmanager
def temporary_folder(parent: Path | None = None) -> Iterator[Path]:
    """A new, locked folder in `parent`, default that of temporary files; removed with its content on exit.

    Raises OSError.
    """
    descriptor, folder = _new_folder(parent)
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        os.close(descriptor)


def _new_folder(parent: Path | None) -> tuple[int, Path]:
    for _ in range(_ATTEMPTS):
        folder = Path(tempfile.mkdtemp(prefix=FOLDER_PREFIX, dir=parent))
        with suppress(FileNotFoundError):  # another process removed it as abandoned before it was locked
            descriptor = open_itself(folder)
            if hold(descriptor, folder):
                return descriptor, folder
            os.close(descriptor)
    raise FileNotFoundError(
        f"Other processes keep removing new folders from {parent or tempfile.gettempdir()}."
    )


def remove_abandoned_folders(parent: Path | None = None) -> None:
    """Remove folders that `temporary_folder` created in processes that have since been killed."""
    with suppress(OSError):  # there may be no folder for temporary files
        remove_abandoned(parent or Path(tempfile.gettempdir()), prefix=FOLDER_PREFIX)


def remove_abandoned(folder: Path, *, prefix: str, suffix: str = "") -> None:
    """Remove unlocked files and folders in `folder` whose names have `prefix` and `suffix`.

    Does not follow links and skips anything that cannot be removed. Raises OSError if `folder` cannot be
    listed.
    """
    for path in folder.iterdir():
        if path.name.startswith(prefix) and path.name.endswith(suffix):
            with suppress(OSError, RecursionError):  # the latter: too deep to be ours
                _remove_if_abandoned(path)


def _remove_if_abandoned(path: Path) -> None:
    descriptor = open_itself(path)
    try:
        status = os.fstat(descriptor)
        if status.st_uid != os.geteuid():
            return
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)  # raises OSError while the owner lives
        if stat.S_ISREG(status.st_mode):
            path.unlink(missing_ok=True)
        elif stat.S_ISDIR(status.st_mode) and path.name.startswith(FOLDER_PREFIX):
            shutil.rmtree(path, ignore_errors=True)
    finally:
        os.close(descriptor)
