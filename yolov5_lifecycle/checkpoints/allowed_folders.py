"""Restriction of weights files to allowed folders."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Sequence
from pathlib import Path

from yolov5_lifecycle.models.model import WeightsError


def confined(path: Path, folders: Sequence[Path]) -> Path:
    """`path` with links and `..` resolved, if the result is in or is one of `folders`.

    Expands a leading ~. Raises WeightsError, with the same message whether the file exists or not.
    """
    with contextlib.suppress(RuntimeError, ValueError):  # unknown home folder, NUL character
        # abspath removes `..` lexically: following a link outside the folders would reveal that it exists.
        real = Path(os.path.realpath(os.path.abspath(path.expanduser())))  # noqa: PTH100
        if any(real.is_relative_to(os.path.realpath(folder.expanduser())) for folder in folders):
            return real
    raise WeightsError(
        f"{path}: it does not lie in a folder that weights may come from: {', '.join(map(str, folders))}. "
        "Move it there, or start the process with another `weights_dirs`."
    )
