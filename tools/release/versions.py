"""The version, wherever it is written."""

from __future__ import annotations

import re
from pathlib import Path

_PLACES = {
    "package.xml": r"<version>(.*)</version>",
    "interfaces/pyproject.toml": r'^version = "(.*)"$',
    "CITATION.cff": r"^version: [\"']?([^\"'\n]+)[\"']?$",
    "CHANGELOG.md": r"^## \[(\d.*?)\]",
}
"""Where it is written, if the file exists, and how; of the changelog, the newest release."""


def version_problems(folder: Path, tag: str = "") -> list[str]:
    """Where the version differs from that of package.xml or of a `tag`, one line each.

    The changelog may lack the version before the first release, unless there is a `tag`.
    """
    found = {
        place: _written(folder / place, pattern)
        for place, pattern in _PLACES.items()
        if (folder / place).exists()
    }
    version = found["package.xml"]
    problems = [
        f"{place}: expected version {version}, as in package.xml, found {written or 'none'}"
        for place, written in found.items()
        if written != version and (written or tag or place != "CHANGELOG.md")
    ]
    if tag and tag != f"v{version}":
        problems.insert(0, f"tag {tag}: expected v{version}, the version in package.xml")
    return problems


def _written(file: Path, pattern: str) -> str | None:
    match = re.search(pattern, file.read_text(encoding="utf-8"), re.MULTILINE)
    return match[1] if match else None
