"""Paths relative to the share folder of an installed ROS package."""

from __future__ import annotations

import os
from pathlib import Path

_SCHEME = "package://"


def resolve_package(path: str) -> str:
    """Resolve `package://PACKAGE/PATH` to a path in the package's share folder; returns others unchanged.

    Searches the sourced environment in order, like ROS. Raises ValueError if the package is not found.
    """
    if not path.startswith(_SCHEME):
        return path
    package, _, rest = path.removeprefix(_SCHEME).partition("/")
    for prefix in filter(None, os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)):
        share = Path(prefix, "share")
        marker = share / "ament_index" / "resource_index" / "packages" / package
        if os.path.isfile(marker):  # noqa: PTH113 - Path.is_file raises if the name is too long
            return str(share / package / rest)
    raise ValueError(
        f"{path}: no package '{package}' is installed in this environment. "
        "Source the workspace that has it, or give the path of the file."
    )
