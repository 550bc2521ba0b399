"""What a check finds on a machine: a line of the report, which may go into a public issue."""

from __future__ import annotations

import os
import pwd
import re
import socket
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from yolov5_lifecycle.printable import in_one_line

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

# Names that images and installers give to everybody, and that occur in paths and messages.
_GENERIC = re.compile("root|ubuntu|debian|ros|user|admin|pi|jetson|localhost|docker|nobody", re.IGNORECASE)
_IDENTIFIERS = (
    (re.compile(r"(/home/|/Users/)[^/\s:'\"]+"), r"\1(user)"),
    (re.compile(r"\b(?:[0-9A-Fa-f]{2}:){5}[0-9A-Fa-f]{2}\b"), "(address)"),
    (
        re.compile(
            r"(?<![\d.])(?:(?:10|127)\.\d{1,3}|192\.168|172\.(?:1[6-9]|2\d|3[01]))(?:\.\d{1,3}){2}(?![\d]|\.\d)"
        ),
        "(address)",
    ),
    (re.compile(r"\b(?:GPU|MIG)-[0-9a-fA-F-]{32,36}"), "(serial)"),
    (re.compile(r"/dev/(?:v4l|serial)/by-id/\S+"), "/dev/(serial)"),
)


def without_private_names(text: str) -> str:
    """`text` with ~ for the home folder, and without this user and host, addresses and serial numbers.

    Names of fewer than two letters, and those that many machines have in common, such as `ubuntu`, are kept.
    """
    homes = {os.path.expanduser("~")}  # noqa: PTH111 - Path.expanduser raises without a home
    homes |= {str(Path(each).resolve()) for each in homes}
    for each in sorted(homes - {"/", "~"}, key=len, reverse=True):
        text = re.sub(rf"{re.escape(each.rstrip('/'))}(?![\w.-])", "~", text)
    for pattern, replacement in _IDENTIFIERS:
        text = pattern.sub(replacement, text)
    host = socket.gethostname()
    for names, replacement in (({host, host.partition(".")[0]}, "(host)"), (_users(), "(user)")):
        for name in sorted(names, key=len, reverse=True):  # a whole name before its first part
            if len(name) > 1 and not _GENERIC.fullmatch(name):
                text = re.sub(rf"(?<![\w-]){re.escape(name)}(?![\w-])", replacement, text)
    return text


def _users() -> set[str]:
    """The names of the user who runs this process."""
    names = {os.environ.get(variable, "") for variable in ("USER", "LOGNAME")}
    with suppress(KeyError):  # a container with a user id that has no entry
        names.add(pwd.getpwuid(os.geteuid()).pw_name)
    return names


def public(finding: Finding) -> Finding:
    """`finding` without names of people and machines, each text one line of printable characters."""
    found, remedy = (in_one_line(without_private_names(text)) for text in (finding.found, finding.remedy))
    return Finding(in_one_line(finding.subject), finding.level, found, remedy)
