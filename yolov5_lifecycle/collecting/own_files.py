"""Files in a folder of collected images, which may be another robot's: regular files in folders, no links."""

from __future__ import annotations

import os
import stat
from pathlib import Path

_KINDS = {"l": "a link", "d": "a folder", "-": "a file"}


class CollectingError(ValueError):
    """Nothing can be kept now, or read; the message has the cause and a remedy."""


def own_bytes(folder: Path, path: str, max_bytes: int | None = None) -> int | None:
    """How many bytes the regular file at `path`, names with / between them, below `folder` has; None if it is
    not there. Without `max_bytes`: those of the folder at `path`.

    Raises CollectingError if it has more or, like a folder that leads to it, is something else: a link leads
    elsewhere. `folder` itself may be a link. Raises OSError.
    """
    parent = path.rpartition("/")[0]
    if parent and own_bytes(folder, parent) is None:
        return None
    try:
        status = os.lstat(folder / path)
    except (FileNotFoundError, NotADirectoryError):
        return None
    is_right, expected = (stat.S_ISDIR, "a folder") if max_bytes is None else (stat.S_ISREG, "a regular file")
    found = _KINDS.get(stat.filemode(status.st_mode)[0], "a pipe or device")
    if not is_right(status.st_mode):
        remedy = "replace it by a copy of what should be there"
        raise CollectingError(f"{folder / path}: expected {expected}, found {found}; {remedy}")
    if max_bytes is not None and status.st_size > max_bytes:
        remedy = "remove the file, or use another folder"
        raise CollectingError(
            f"{folder / path}: expected at most {max_bytes:,} bytes, found {status.st_size:,}; {remedy}"
        )
    return status.st_size
