"""What the checks need: files with fuzzed bytes, refusals as the right answer."""

from __future__ import annotations

import atexit
import shutil
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import TypeVar

Taken = TypeVar("Taken")


def taken(take: Callable[[], Taken], refusal: type[Exception]) -> Taken | None:
    """The result of `take`, None if it raises the `refusal`, which must be one line; others propagate."""
    try:
        return take()
    except refusal as error:
        assert str(error).isprintable(), repr(error)
        return None


@cache
def folder() -> Path:
    """Removed at the end."""
    made = Path(tempfile.mkdtemp()).resolve()
    atexit.register(shutil.rmtree, made, ignore_errors=True)
    return made


def written(name: str, data: bytes) -> Path:
    """The file of this name in `folder()`, with `data`."""
    path = folder() / name
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(data)
    return path
