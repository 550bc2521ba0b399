"""Files that are there whole or not at all."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

NO_PLACE = (OSError, RuntimeError)
"""What writing and reading below ~ may raise; the latter where there is no home folder."""


def write_whole(path: Path, *parts: bytes) -> None:
    """`parts`, one after the other, in a folder that is made if need be. Raises NO_PLACE."""
    path = path.expanduser()
    path.parent.mkdir(parents=True, exist_ok=True)
    descriptor, beside = tempfile.mkstemp(dir=path.parent, prefix=f"{path.name}.")
    try:
        with os.fdopen(descriptor, "wb") as file:
            file.writelines(parts)
        Path(beside).replace(path)
    finally:
        Path(beside).unlink(missing_ok=True)
