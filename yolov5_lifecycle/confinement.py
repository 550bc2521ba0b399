"""The folders outside of which no weights file is looked at."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Sequence
from pathlib import Path

from yolov5_lifecycle.model import WeightsError


def confined(path: Path, folders: Sequence[Path]) -> Path:
    """`path` without links and dots, if it then lies in one of `folders` or is one of them.

    A leading ~ is the home folder. Raises WeightsError, in the same words whether there is such a file or
    not.
    """
    with contextlib.suppress(RuntimeError, ValueError):  # no such home folder, a NUL
        # abspath takes `..` as text: to follow a link outside would tell that it is there.
        real = Path(os.path.realpath(os.path.abspath(path.expanduser())))  # noqa: PTH100
        if any(real.is_relative_to(os.path.realpath(folder.expanduser())) for folder in folders):
            return real
    raise WeightsError(
        f"{path}: it does not lie in a folder that weights may come from: {', '.join(map(str, folders))}. "
        "Move it there, or start the process with another `weights_dirs`."
    )
