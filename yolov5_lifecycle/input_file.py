"""Files named by the user: found in ROS packages, read up to a limit."""

from __future__ import annotations

import codecs
import os
import stat
import sys
from pathlib import Path

_SCHEME = "package://"


def resolve_package(path: str) -> str:
    """Resolve `package://PACKAGE/PATH` to a path in the package's share folder; returns others unchanged.

    Searches the sourced environment in order, like ROS; this package itself is also found without one.
    Raises ValueError if the package is not found.
    """
    if not path.startswith(_SCHEME):
        return path
    package, _, rest = path.removeprefix(_SCHEME).partition("/")
    sourced = filter(None, os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep))
    # A package lies below the prefix of its share folder, except one that pip installed as editable.
    own = [*map(str, Path(__file__).parents), sys.prefix] if package == __package__ else []
    for prefix in (*sourced, *own):
        share = Path(prefix, "share")
        marker = share / "ament_index" / "resource_index" / "packages" / package
        if os.path.isfile(marker):  # noqa: PTH113 - Path.is_file raises if the name is too long
            return str(share / package / rest)
    raise ValueError(
        f"{path}: no package '{package}' is installed in this environment. "
        "Source the workspace that has it, or give the path of the file."
    )


class RegularFileError(ValueError):
    """The path is not a regular file, or the file is too large."""


def read_regular_file(path: Path, max_bytes: int) -> bytes:
    """The content of a regular file, or of a link to one, of at most `max_bytes` bytes.

    Never blocks on a pipe. Raises RegularFileError and OSError.
    """
    if "\0" in str(path):
        raise RegularFileError("expected a path without null characters")
    _check_regular(path.stat())  # opening some devices acts
    # Without O_NONBLOCK, opening a pipe without a writer blocks forever.
    with open(path, "rb", opener=lambda name, flags: os.open(name, flags | os.O_NONBLOCK)) as file:
        status = os.fstat(file.fileno())
        _check_regular(status)
        if status.st_size > max_bytes:
            raise RegularFileError(f"found more than {max_bytes} bytes, the limit")
        return file.read(status.st_size)


def _check_regular(status: os.stat_result) -> None:
    if not stat.S_ISREG(status.st_mode):
        found = "folder" if stat.S_ISDIR(status.st_mode) else "pipe or device"
        raise RegularFileError(f"expected a regular file, found a {found}")


def read_text_file(path: Path, max_bytes: int) -> bytes:
    """The content of a text file in UTF-8, without byte-order marks, also if it was saved as UTF-16.

    Raises RegularFileError and OSError, like `read_regular_file`.
    """
    content = read_regular_file(path, max_bytes)
    if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        try:
            content = content.decode("utf-16").encode()
        except UnicodeDecodeError:
            raise RegularFileError("expected a text, found other bytes") from None
    return content.replace(codecs.BOM_UTF8, b"")
