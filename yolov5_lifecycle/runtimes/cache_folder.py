"""The user's cache folder; all cache files are read and written here."""

from __future__ import annotations

import os
import stat
from contextlib import suppress
from pathlib import Path

from yolov5_lifecycle.atomic_file import UNFINISHED_PREFIX, UNFINISHED_SUFFIX, write_whole
from yolov5_lifecycle.unfinished import open_itself, remove_abandoned

NO_PLACE = (OSError, RuntimeError)
"""Errors of cache reads and writes; RuntimeError when there is no home folder."""


def cache_folder(name: str) -> Path:
    """$XDG_CACHE_HOME/yolov5_lifecycle/`name`, default ~/.cache; ~ is not expanded."""
    cache = os.environ.get("XDG_CACHE_HOME", "")
    root = Path(cache if Path(cache).is_absolute() else "~/.cache")
    return root / "yolov5_lifecycle" / name


def read_cache(path: Path, max_bytes: int, *, head_bytes: int = 0) -> tuple[bytes, bytes] | None:
    """The first `head_bytes` and the rest of the file at `path`, which may begin with ~.

    None unless it is a readable regular file of at most `max_bytes`: symlinks are not followed, and pipes or
    devices do not block.
    """
    try:
        with open(path.expanduser(), "rb", opener=open_itself) as file:
            status = os.fstat(file.fileno())
            if not stat.S_ISREG(status.st_mode) or status.st_size > max_bytes:
                return None
            return file.read(head_bytes), file.read(status.st_size)
    except NO_PLACE:
        return None


def write_cache(path: Path, *parts: bytes) -> None:
    """Write a file atomically, creating its folder if needed; `path` may begin with ~. Raises NO_PLACE.

    Removes unfinished files of processes that were killed while writing there.
    """
    path = path.expanduser()
    path.parent.mkdir(parents=True, exist_ok=True)
    with suppress(OSError):
        remove_abandoned(path.parent, prefix=UNFINISHED_PREFIX, suffix=UNFINISHED_SUFFIX)
    write_whole(path, *parts, is_durable=False)
