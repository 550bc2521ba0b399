"""Files that are there whole or not at all."""

from __future__ import annotations

import os
from pathlib import Path

NO_PLACE = (OSError, RuntimeError)
"""What writing and reading below ~ may raise; the latter where there is no home folder."""


def write_whole(path: Path, *parts: bytes) -> None:
    """`parts`, one after the other, in a folder that is made if need be. Raises NO_PLACE."""
    path = path.expanduser()
    path.parent.mkdir(parents=True, exist_ok=True)
    beside = path.with_suffix(f".{os.getpid()}")
    try:
        with beside.open("wb") as file:
            file.writelines(parts)
        beside.replace(path)
    finally:
        beside.unlink(missing_ok=True)
