"""The user's cache of what was measured: small files, each written whole."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

from yolov5_lifecycle.atomic_file import atomic_write, remove_abandoned_folders
from yolov5_lifecycle.input_file import read_regular_file

MAX_BYTES = 1 << 20
NO_PLACE = (OSError, RuntimeError)
"""Errors of a cache that cannot be used; RuntimeError when there is no home folder."""


def cache_folder() -> Path:
    """$XDG_CACHE_HOME/yolov5_lifecycle/choices, default ~/.cache; ~ is not expanded."""
    cache = os.environ.get("XDG_CACHE_HOME", "")
    root = Path(cache if Path(cache).is_absolute() else "~/.cache")
    return root / "yolov5_lifecycle" / "choices"


def write_cache(path: Path, content: object) -> None:
    """Write `content` as JSON, creating the folder if needed; `path` may begin with ~. Raises NO_PLACE.

    Removes what processes that were killed while writing there left unfinished.
    """
    path = path.expanduser()
    path.parent.mkdir(parents=True, exist_ok=True)
    remove_abandoned_folders(path.parent)
    atomic_write(path, json.dumps(content).encode(), is_durable=False)


def read_cache(path: Path) -> Any:
    """What was written at `path`, which may begin with ~; None if it is missing or damaged."""
    try:
        return json.loads(read_regular_file(path.expanduser(), MAX_BYTES))
    except (*NO_PLACE, ValueError):
        return None
