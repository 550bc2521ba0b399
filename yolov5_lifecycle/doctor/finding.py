"""What a check found, and the line of the report that shows it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

Level = Literal["ok", "warning", "error"]

_MAX_FILE_BYTES = 1 << 16


@dataclass(frozen=True)
class Finding:
    """What was found, and what to do unless it is ok. Raises ValueError without one or the other."""

    level: Level
    found: str
    remedy: str = ""

    def __post_init__(self) -> None:
        if not self.found or (self.level == "ok") == bool(self.remedy):
            raise ValueError(f"A finding needs a text and, unless it is ok, a remedy: {self}")


def ok(found: str) -> Finding:
    return Finding("ok", found)


def warning(found: str, *, remedy: str) -> Finding:
    """Detection works, but worse than this machine could, or something optional does not work."""
    return Finding("warning", found, remedy)


def error(found: str, *, remedy: str) -> Finding:
    """Detection does not work, or not as the user has set it."""
    return Finding("error", found, remedy)


class Line(NamedTuple):
    """A line of the report."""

    subject: str
    finding: Finding


@dataclass(frozen=True)
class Machine:
    """The machine to check: /proc, /sys, /etc and /dev lie in the folder `root`.

    `target`: the runtime or device to check, for a check that is made once for each.
    """

    root: Path = Path("/")
    target: str = ""

    def path(self, name: str) -> Path:
        """The absolute path `name` of the machine, below `root`."""
        return self.root / name.lstrip("/")

    def text(self, name: str) -> str:
        """The first 64 KiB of the file `name`; "" if it cannot be read."""
        try:
            with self.path(name).open("rb") as file:
                return file.read(_MAX_FILE_BYTES).decode(errors="replace")
        except OSError:
            return ""


Check = Callable[[Machine], Iterator[Finding]]
"""What a check finds; nothing where it does not apply."""
