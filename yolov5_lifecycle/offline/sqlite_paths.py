"""Paths at which rosbags opens no SQLite file, or another one: it puts them into a URI unescaped."""

from __future__ import annotations

import re

# What SQLite does not take literally in `file:PATH`: a host, fragment, query, escape, or what is not UTF-8.
_SPECIAL = re.compile(r"^//(?!/)|[#?]|%[0-9A-Fa-f]{2}|[\ud800-\udfff]")


def sqlite_problem(path: object) -> str:
    """Why rosbags cannot open an SQLite file at `path`, or ""."""
    found = _SPECIAL.search(str(path))
    return f"an SQLite file cannot be opened with {found[0]!r} in its path" if found else ""
