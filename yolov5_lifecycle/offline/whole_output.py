"""Files and folders that appear complete or not at all."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory


class OutputError(ValueError):
    """Something cannot be written where it was asked for; says why and what to do."""


@contextmanager
def whole_output(path: Path) -> Iterator[Path]:
    """Where to write the file or folder that shall be `path`: it gets there when the block ends well.

    Until then, and if it does not, nothing is at `path`. Raises OutputError if something is there already.
    """
    _check_free(path)
    if not path.parent.is_dir():
        raise OutputError(f"{path.parent}: there is no such folder; make it first.")
    with TemporaryDirectory(prefix=".unfinished-", dir=path.parent) as folder:
        unfinished = Path(folder, path.name)
        yield unfinished
        _check_free(path)
        unfinished.rename(path)


def _check_free(path: Path) -> None:
    if os.path.lexists(path):
        raise OutputError(f"{path} exists and is not replaced: choose another name or remove it.")
