"""The notes of a release are what the changelog says about its version."""

from __future__ import annotations

import subprocess
import sys

import pytest
from support.colcon_workspace import REPOSITORY

from tools.release_notes import ReleaseNotesError, notes

pytestmark = pytest.mark.long

TOOL = REPOSITORY / "tools" / "release_notes.py"
CHANGELOG = """\
# Changelog

## [Unreleased]

### Added
- Not yet.

## [1.10.0] - 2027-01-02

### Fixed
- Ten.

## [1.1.0] - 2026-12-24

First version.

### Added
- One.
- `## [9.9.9]` in the text is no heading.

## [1.0.0] - 2026-12-01
## [0.9.0]
- Oldest.

[1.0.0]: https://example.org/1.0.0
"""


@pytest.mark.parametrize(
    ("version", "expected"),
    [
        pytest.param("1.10.0", "### Fixed\n- Ten.\n", id="newest"),
        pytest.param(
            "1.1.0",
            "First version.\n\n### Added\n- One.\n- `## [9.9.9]` in the text is no heading.\n",
            id="its number begins another",
        ),
        pytest.param("0.9.0", "- Oldest.\n", id="last, without a date, above the links"),
    ],
)
def test_the_notes_are_the_section_of_the_version(version: str, expected: str) -> None:
    assert notes(CHANGELOG, f"v{version}") == expected


@pytest.mark.parametrize(
    "version",
    [
        pytest.param("2.0.0", id="no heading"),
        pytest.param("1.0.0", id="nothing below the heading"),
        pytest.param("1.1", id="beginning of another number"),
        pytest.param("1x1.0", id="a pattern that fits another number"),
        pytest.param("", id="empty"),
    ],
)
def test_a_version_without_changes_is_refused_with_the_remedy(version: str) -> None:
    with pytest.raises(ReleaseNotesError, match="Rename the heading '## \\[Unreleased]'"):
        notes(CHANGELOG, f"v{version}")


@pytest.mark.parametrize("tag", ["1.1.0", "refs/tags/v1.1.0", ""])
def test_a_tag_without_v_is_refused(tag: str) -> None:
    with pytest.raises(ReleaseNotesError, match="behind 'v'"):
        notes(CHANGELOG, tag)


@pytest.mark.parametrize(
    ("arguments", "code"),
    [pytest.param([], 2, id="no tag"), pytest.param(["v999.0.0"], 1, id="a version without changes")],
)
def test_the_command_explains_what_is_wrong_without_any_package(arguments: list[str], code: int) -> None:
    command = [sys.executable, "-I", "-S", str(TOOL), *arguments]
    run = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (run.returncode, run.stdout) == (code, "")
    assert run.stderr.endswith("\n")
    assert "Traceback" not in run.stderr
