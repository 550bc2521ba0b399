"""Files and folders that are either complete or absent: written in a hidden folder, then renamed.

The hidden folder is locked by flock(2). The kernel releases the lock when the process ends for any reason, so
neither a stale folder nor a reused process id can be mistaken for one of a living process.
"""

from __future__ import annotations

import fcntl
import os
import shutil
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

FOLDER_PREFIX = ".yolov5_lifecycle-unfinished-"
"""No other folder has such a name: one that is abandoned is removed with all that is in it."""
_ATTEMPTS = 20


class OutputError(ValueError):
    """Output that cannot be written to the requested path; the message has the cause and a remedy."""


def atomic_write(path: Path, *parts: bytes, is_durable: bool = True) -> None:
    """Atomically replace the file at `path` with the concatenated `parts`; readable by all users.

    If not `is_durable`, a power failure may leave a damaged file. A killed process leaves a hidden folder
    next to it, see `remove_abandoned_folders`. Raises OSError.
    """
    with temporary_folder(path.parent) as folder:
        _written(folder, parts, is_durable=is_durable).replace(path)


def write_together(contents: Mapping[Path, bytes]) -> None:
    """Like `atomic_write` for each path, in order, after all of them have been written. Raises OSError."""
    with ExitStack() as stack:
        unfinished = {
            path: _written(stack.enter_context(temporary_folder(path.parent)), [content], is_durable=True)
            for path, content in contents.items()
        }
        for path, file in unfinished.items():
            file.replace(path)


def _written(folder: Path, parts: Iterable[bytes], *, is_durable: bool) -> Path:
    """A file in the temporary `folder` with `parts` in it, whose name no reader of the target takes."""
    path = folder / "unfinished"
    with path.open("wb") as file:
        file.writelines(parts)
        file.flush()
        if is_durable:
            os.fsync(file.fileno())
        os.fchmod(file.fileno(), 0o644)
    return path


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
    if not os.access(path.parent, os.W_OK):
        raise OutputError(f"{path.parent}: not writable; choose a folder of yours.")
    remove_abandoned_folders(path.parent)
    with temporary_folder(path.parent) as folder:
        unfinished = folder / path.name
        yield unfinished
        _check_free(path)
        unfinished.rename(path)


def _check_free(path: Path) -> None:
    if os.path.lexists(path):
        raise OutputError(f"{path} exists and is not replaced: choose another name or remove it.")


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
    """Remove folders that `temporary_folder` created in processes that have since been killed.

    Only those of this user; links and what cannot be removed are left alone.
    """
    with suppress(OSError):  # there may be no folder for temporary files
        for folder in (parent or Path(tempfile.gettempdir())).iterdir():
            if folder.name.startswith(FOLDER_PREFIX):
                with suppress(OSError, RecursionError):  # the latter: too deep to be ours
                    _remove_if_abandoned(folder)


def _remove_if_abandoned(folder: Path) -> None:
    descriptor = open_itself(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        if os.fstat(descriptor).st_uid == os.geteuid():
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)  # raises OSError while the owner lives
            shutil.rmtree(folder, ignore_errors=True)
    finally:
        os.close(descriptor)


def hold(descriptor: int, path: Path) -> bool:
    """Lock the file or folder `path`, open as `descriptor`, until the descriptor is closed.

    Returns False if another process has locked or removed it. On a file system without locks, returns True:
    `remove_abandoned_folders` needs the lock, so it removes nothing there. Raises OSError.
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
