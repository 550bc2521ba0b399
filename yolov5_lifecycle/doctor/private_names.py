"""Removal of names that identify a person or a machine from text that goes into a public issue."""

from __future__ import annotations

import os
import pwd
import re
import socket
from collections.abc import Collection
from contextlib import suppress
from pathlib import Path

# Names that images and installers give to everybody, and that occur in paths and messages.
_GENERIC = {
    "root",
    "ubuntu",
    "debian",
    "ros",
    "user",
    "admin",
    "pi",
    "jetson",
    "localhost",
    "docker",
    "nobody",
}
_HOME_OF_OTHERS = re.compile(r"(/home/|/Users/)[^/\s:'\"]+")
_IDENTIFIERS = (
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


def this_user() -> set[str]:
    """The names of the user who runs this process."""
    names = {os.environ.get(variable, "") for variable in ("USER", "LOGNAME")}
    with suppress(KeyError):  # a container with a user id that has no entry
        names.add(pwd.getpwuid(os.geteuid()).pw_name)
    return names


def this_host() -> set[str]:
    """The names of this machine, with and without its domain."""
    name = socket.gethostname()
    return {name, name.partition(".")[0]}


def without_private_names(
    text: str,
    *,
    home: str | None = None,
    users: Collection[str] | None = None,
    hosts: Collection[str] | None = None,
) -> str:
    """`text` with ~ for the home folder, and without users, hosts, addresses and serial numbers.

    The names are by default those of this process. Names of fewer than two letters, and those that many
    machines have in common, such as `ubuntu`, are kept.
    """
    homes = {home or os.path.expanduser("~")}  # noqa: PTH111 - Path.expanduser raises without a home
    homes |= {str(Path(each).resolve()) for each in homes}
    for each in sorted(homes - {"/", "~"}, key=len, reverse=True):
        text = re.sub(rf"{re.escape(each.rstrip('/'))}(?![\w.-])", "~", text)
    text = _HOME_OF_OTHERS.sub(r"\1(user)", text)
    for pattern, replacement in _IDENTIFIERS:
        text = pattern.sub(replacement, text)
    for names, replacement in ((hosts or this_host(), "(host)"), (users or this_user(), "(user)")):
        for name in sorted(names, key=len, reverse=True):  # a whole name before its first part
            if len(name) > 1 and name.lower() not in _GENERIC:
                text = re.sub(rf"(?<![\w-]){re.escape(name)}(?![\w-])", replacement, text)
    return text
