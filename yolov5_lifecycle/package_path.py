"""Paths that name a file by the ROS package it is installed with."""

from __future__ import annotations

import os
from pathlib import Path

_SCHEME = "package://"


def resolve_package(path: str) -> str:
    """`package://PACKAGE/PATH` as a path in the package's share folder; anything else as it is.

    The package is looked for in the environment that was sourced, first come first served, as ROS does.
    Raises ValueError when it is not there.
    """
    if not path.startswith(_SCHEME):
        return path
    package, _, rest = path.removeprefix(_SCHEME).partition("/")
    for prefix in filter(None, os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)):
        share = Path(prefix, "share")
        marker = share / "ament_index" / "resource_index" / "packages" / package
        if os.path.isfile(marker):  # noqa: PTH113 - Path.is_file raises for a name that is too long
            return str(share / package / rest)
    raise ValueError(
        f"{path}: no package '{package}' is installed in this environment. "
        "Source the workspace that has it, or give the path of the file."
    )
