"""What a check finds on a machine: a line of the report."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

Level = Literal["ok", "warning", "error"]


@dataclass(frozen=True)
class Finding:
    """What was found about `subject`, which its check need not name, and what to do unless it is ok."""

    subject: str
    level: Level
    found: str
    remedy: str


def ok(found: str) -> Finding:
    return Finding("", "ok", found, "")


def warning(found: str, *, remedy: str) -> Finding:
    """Detection works, but worse than this machine could, or something optional does not work."""
    return Finding("", "warning", found, remedy)


def error(found: str, *, remedy: str) -> Finding:
    """Detection does not work, or not as the user has set it."""
    return Finding("", "error", found, remedy)


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
        """The content of the file `name`; "" if it cannot be read."""
        try:
            return self.path(name).read_text(errors="replace")
        except OSError:
            return ""


Check = Callable[[Machine], Iterator[Finding]]
"""What a check finds; nothing where it does not apply."""
Groups = dict[str, dict[str, Check]]
"""The checks of a module by the name of their examination and their subject."""
