"""Prints the changes of one version from CHANGELOG.md: python3 tools/release_notes.py v0.1.0

It needs nothing but Python, because the workflow that releases runs it before anything is installed.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

REPOSITORY = Path(__file__).parents[1]


def notes(changelog: str, tag: str) -> str:
    """The text below the heading of the version of `tag`, such as v0.1.0, in `changelog`.

    Raises ValueError if the tag does not begin with v, or nothing is said about its version.
    """
    version = tag.removeprefix("v")
    if version == tag:
        raise ValueError(f"tag {tag!r}: expected a version behind 'v', such as v0.1.0. Rename the tag.")
    section = re.search(
        rf"^## \[{re.escape(version)}\][^\n]*\n(.*?)(?=^## |^\[[^\]\n]+\]: |\Z)",
        changelog,
        re.MULTILINE | re.DOTALL,
    )
    if section is None or not section[1].strip():
        raise ValueError(
            f"CHANGELOG.md: expected changes below a heading '## [{version}] - YYYY-MM-DD', found none. "
            "Rename the heading '## [Unreleased]' to it, and begin a new one."
        )
    return section[1].strip() + "\n"


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("usage: python3 tools/release_notes.py TAG, for example v0.1.0")
    try:
        sys.stdout.write(notes((REPOSITORY / "CHANGELOG.md").read_text(encoding="utf-8"), sys.argv[1]))
    except ValueError as error:
        sys.exit(str(error))
