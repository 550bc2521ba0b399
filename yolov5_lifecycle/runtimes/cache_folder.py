"""Where the user's cache is."""

from __future__ import annotations

import os
from pathlib import Path

from yolov5_lifecycle.whole_file import write_whole

NO_PLACE = (OSError, RuntimeError)
"""What reading and writing there may raise; the latter where there is no home folder."""


def cache_folder(name: str) -> Path:
    """$XDG_CACHE_HOME/yolov5_lifecycle/`name`, XDG_CACHE_HOME being ~/.cache by default; ~ stays as it is."""
    cache = os.environ.get("XDG_CACHE_HOME", "")
    root = Path(cache if Path(cache).is_absolute() else "~/.cache")
    return root / "yolov5_lifecycle" / name


def write_cache(path: Path, *parts: bytes) -> None:
    """A whole file in a folder that is made if need be; `path` may begin with ~. Raises NO_PLACE."""
    path = path.expanduser()
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, *parts, is_durable=False)
