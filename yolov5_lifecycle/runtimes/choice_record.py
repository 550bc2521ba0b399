"""Measured figures on disk: a small JSON file for each circumstance, at a path that may begin with ~."""

from __future__ import annotations

import json
import math
from collections.abc import Collection, Mapping
from pathlib import Path

from yolov5_lifecycle.runtimes.cache_folder import NO_PLACE, write_cache


def read_figures(path: Path, runtimes: Collection[str]) -> dict[str, float] | None:
    """Milliseconds by runtime; None when there is no such file or not what `write_figures` writes.

    One that is damaged is as good as none: it is written anew after the next measurement.
    """
    try:
        figures_ms = json.loads(path.expanduser().read_text(encoding="utf-8"))
    except (*NO_PLACE, ValueError):
        return None
    usable = isinstance(figures_ms, dict) and "torch" in figures_ms
    if usable and all(name in runtimes and _is_duration(ms) for name, ms in figures_ms.items()):
        return figures_ms  # type: ignore[no-any-return]
    return None


def write_figures(path: Path, figures_ms: Mapping[str, float]) -> str:
    """Whole or not at all; why it could not be written, "" when it was."""
    try:
        write_cache(path, json.dumps(figures_ms).encode() + b"\n")
    except NO_PLACE as error:
        return f"measured now, not remembered: {error}"
    return ""


def _is_duration(value: object) -> bool:
    return isinstance(value, float) and math.isfinite(value) and value > 0
