"""Folders named by the user: listed up to a limit."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

MAX_ENTRIES = 1_000_000
"""Files and folders; listing that many takes about a second."""


def _too_many(folder: Path) -> OSError:
    return OSError(
        f"{folder}: expected at most {MAX_ENTRIES:,} files and folders, found more: name a smaller folder."
    )


def entries(folder: Path) -> Iterator[Path]:
    """What is directly in `folder`, in any order; raises OSError, also beyond MAX_ENTRIES entries."""
    with os.scandir(folder) as found:
        for count, entry in enumerate(found, start=1):
            if count > MAX_ENTRIES:
                raise _too_many(folder)
            yield Path(entry.path)


class FolderTree:
    """The files in folders and below them; all calls of `files` together list MAX_ENTRIES entries."""

    def __init__(self) -> None:
        self._listed = 0

    def files(self, folder: Path) -> Iterator[Path]:
        """The files below `folder`, in any order; links to folders are not followed.

        One that has gone is left out. Raises OSError for one that cannot be listed, as a part would pass for
        the whole, and beyond MAX_ENTRIES entries.
        """
        waiting = [os.fspath(folder)]
        while waiting:
            for entry in _listed(waiting.pop()):
                self._listed += 1
                if self._listed > MAX_ENTRIES:
                    raise _too_many(folder)
                if entry.is_dir(follow_symlinks=False):
                    waiting.append(entry.path)
                else:
                    yield Path(entry.path)


def _listed(folder: str) -> Iterator[os.DirEntry[str]]:
    """What is in `folder`, one by one; nothing if it is not there. Raises OSError."""
    try:
        with os.scandir(folder) as found:
            yield from found
    except (FileNotFoundError, NotADirectoryError):
        return
    except OSError as error:
        raise OSError(
            f"{folder}: cannot be listed ({error.strerror}): let this user read it, or move it away"
        ) from None
