"""Prints the changes of one version from CHANGELOG.md: python3 tools/release_notes.py v0.1.0

It needs nothing but Python, because the workflow that releases runs it before anything is installed.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

REPOSITORY = Path(__file__).parents[1]


class ReleaseNotesError(ValueError):
    """A release that cannot be announced, with the remedy."""


def notes(changelog: str, tag: str) -> str:
    """The text below the heading of the version of `tag`, such as v0.1.0, in `changelog`.

    Raises ReleaseNotesError if the tag does not begin with v, or nothing is said about its version.
    """
    version = tag.removeprefix("v")
    if version == tag:
        raise ReleaseNotesError(
            f"tag {tag!r}: expected a version behind 'v', such as v0.1.0. Rename the tag."
        )
    section = re.search(
        rf"^## \[{re.escape(version)}\][^\n]*\n(.*?)(?=^## |^\[[^\]\n]+\]: |\Z)",
        changelog,
        re.MULTILINE | re.DOTALL,
    )
    if section is None or not section[1].strip():
        raise ReleaseNotesError(
            f"CHANGELOG.md: expected changes below a heading '## [{version}] - YYYY-MM-DD', found none. "
            "Rename the heading '## [Unreleased]' to it, and begin a new one."
        )
    return section[1].strip() + "\n"


def main(arguments: list[str]) -> int:
    """Exit status: 0 when the notes are printed, 1 with the reason on stderr, 2 for wrong arguments."""
    if len(arguments) != 1:
        sys.stderr.write("usage: python3 tools/release_notes.py TAG, for example v0.1.0\n")
        return 2
    changelog = (REPOSITORY / "CHANGELOG.md").read_text(encoding="utf-8")
    try:
        sys.stdout.write(notes(changelog, arguments[0]))
    except ReleaseNotesError as error:
        sys.stderr.write(f"{error}\n")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
