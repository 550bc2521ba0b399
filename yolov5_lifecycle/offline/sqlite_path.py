"""Paths of SQLite files as rosbags opens them: it puts each into a `file:` URI as it is."""

from __future__ import annotations

import os
from pathlib import PosixPath
from urllib.parse import quote


class UriPath(PosixPath):
    """A path that is escaped where it is formatted, as in `f"file:{path}"`, so that SQLite opens that file.

    SQLite would take `#`, `?`, `%41` and a leading `//` as parts of the URI, see https://sqlite.org/uri.html.
    """

    def __format__(self, specification: str) -> str:
        return format(quote(os.fsencode(self), safe=""), specification)
