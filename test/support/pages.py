"""README, docs/ and what is in them."""

from __future__ import annotations

import re
from pathlib import Path

from support.colcon_workspace import REPOSITORY
from yolov5_lifecycle.ros.topics import published, subscribed

README = REPOSITORY / "README.md"
TUTORIAL = REPOSITORY / "docs" / "tutorial.md"
PAGES = [
    README,
    *(
        REPOSITORY / f"{name}.md"
        for name in ("CODE_OF_CONDUCT", "CONTRIBUTING", "QUALITY_DECLARATION", "SECURITY")
    ),
    *sorted((REPOSITORY / "docs").glob("*.md")),
]
_CAMERAS = ("", "front", "rear")
TOPICS = {*published(_CAMERAS), *subscribed(_CAMERAS), "/diagnostics"}
"""Those of the examples, as ~/name."""


def blocks(page: Path, language: str) -> list[str]:
    """The fenced blocks of `language`."""
    return re.findall(rf"^ *```{language}\n(.*?)^ *```", page.read_text(), re.MULTILINE | re.DOTALL)


def typed(page: Path) -> list[str]:
    """The lines of the console blocks, without the output of a command that is marked with $."""
    lines = []
    for block in blocks(page, "console"):
        marked = [line.removeprefix("$ ") for line in block.splitlines() if line.startswith("$ ")]
        lines += marked or block.splitlines()
    return lines
