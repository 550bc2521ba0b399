"""The versions that the requirements pin."""

from __future__ import annotations

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from support.colcon_workspace import REPOSITORY


def pins(constraints: str) -> dict[str, str]:
    """Package -> version for this Python; files named by -c included."""
    lines = (REPOSITORY / "requirements" / constraints).read_text().splitlines()
    versions: dict[str, str] = {}
    for line in lines:
        if line.startswith("-c "):
            versions |= pins(line.removeprefix("-c "))
        elif line and not line.startswith("#"):
            requirement = Requirement(line)
            if requirement.marker is None or requirement.marker.evaluate():
                versions[canonicalize_name(requirement.name)] = str(requirement.specifier).removeprefix("==")
    return versions
