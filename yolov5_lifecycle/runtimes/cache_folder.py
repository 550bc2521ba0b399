"""Where the user's cache is."""

from __future__ import annotations

import os
from pathlib import Path


def cache_folder(name: str) -> Path:
    """$XDG_CACHE_HOME/yolov5_lifecycle/`name`, XDG_CACHE_HOME being ~/.cache by default; ~ stays as it is."""
    cache = os.environ.get("XDG_CACHE_HOME", "")
    root = Path(cache if Path(cache).is_absolute() else "~/.cache")
    return root / "yolov5_lifecycle" / name
