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

FOLDER_PREFIX = "yolov5_lifecycle-"
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
def temporary_folder(parent: Path | None = None, *, prefix: str = FOLDER_PREFIX) -> Iterator[Path]:
    """A new, locked folder in `parent`, default that of temporary files; removed with its content on exit.

    Raises OSError.
    """
    descriptor, folder = _new_folder(parent, prefix)
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        os.close(descriptor)


def remove_abandoned_folders() -> None:
    """Remove folders that `temporary_folder` created in processes that have since been killed."""
    with suppress(OSError):  # there may be no folder for temporary files
        remove_abandoned(Path(tempfile.gettempdir()), prefix=FOLDER_PREFIX)


def remove_abandoned(folder: Path, *, prefix: str, suffix: str = "", with_subfolders: bool = False) -> None:
    """Remove unlocked files and folders of this user in `folder` whose names have `prefix` and `suffix`.

    A folder that has subfolders belongs to another program and is kept, unless `with_subfolders`. Does not
    follow links and skips pipes, devices and anything that cannot be removed. Raises OSError if `folder`
    cannot be listed.
    """
    for path in folder.iterdir():
        if path.name.startswith(prefix) and path.name.endswith(suffix):
            with suppress(OSError):
                _remove_if_abandoned(path, with_subfolders)


def _new_folder(parent: Path | None, prefix: str) -> tuple[int, Path]:
    for _ in range(_ATTEMPTS):
        folder = Path(tempfile.mkdtemp(prefix=prefix, dir=parent))
        with suppress(FileNotFoundError):  # another process removed it as abandoned before it was locked
            descriptor = open_itself(folder)
            if hold(descriptor, folder):
                return descriptor, folder
            os.close(descriptor)
    raise FileNotFoundError(
        f"Other processes keep removing new folders from {parent or tempfile.gettempdir()}."
    )


def _remove_if_abandoned(path: Path, with_subfolders: bool) -> None:
    descriptor = open_itself(path)
    try:
        status = os.fstat(descriptor)
        is_file_or_folder = stat.S_ISREG(status.st_mode) or stat.S_ISDIR(status.st_mode)
        if is_file_or_folder and status.st_uid == os.geteuid():
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)  # raises OSError while the owner lives
            _remove(path, descriptor, with_subfolders)
    finally:
        os.close(descriptor)


def _remove(path: Path, descriptor: int, with_subfolders: bool) -> None:
    """Remove a file, or a folder with its files."""
    if not stat.S_ISDIR(os.fstat(descriptor).st_mode):
        path.unlink(missing_ok=True)
        return
    if with_subfolders:
        shutil.rmtree(path, ignore_errors=True)  # does not follow links
        return
    for name in os.listdir(descriptor):
        with suppress(OSError):
            os.unlink(name, dir_fd=descriptor)
    with suppress(OSError):
        path.rmdir()
