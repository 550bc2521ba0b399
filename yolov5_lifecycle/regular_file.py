"""Reading of small files that a user names."""

from __future__ import annotations

import os
import stat
from pathlib import Path


class RegularFileError(ValueError):
    """A path that is no regular file, or a file that is too large."""


def read_regular_file(path: Path, max_bytes: int) -> bytes:
    """The content of a regular file, or of a link to one, of at most `max_bytes` bytes.

    Never blocks on a pipe. Raises RegularFileError and OSError.
    """
    if "\0" in str(path):
        raise RegularFileError("expected a path without null characters")
    # Without O_NONBLOCK, opening a pipe without a writer blocks forever.
    with open(path, "rb", opener=lambda name, flags: os.open(name, flags | os.O_NONBLOCK)) as file:
        if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
            raise RegularFileError("expected a regular file, found a pipe or device")
        content = file.read(max_bytes + 1)
    if len(content) > max_bytes:
        raise RegularFileError(f"found more than {max_bytes} bytes, the limit")
    return content
