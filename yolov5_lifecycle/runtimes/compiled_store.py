"""Compiled models on disk, so that each is made once."""

from __future__ import annotations

import hashlib
import logging
import os
import re
from contextlib import suppress
from pathlib import Path

from yolov5_lifecycle.runtimes.cache_folder import NO_PLACE, write_cache

MOST_BYTES = 1 << 30

_DIGEST_BYTES = hashlib.sha256().digest_size
_KEY = re.compile(r"[0-9a-f]{64}")

_log = logging.getLogger(__name__)


class CompiledStore:
    """Bytes by a key of 64 hexadecimal digits, each in a file of its own in a `folder` that may begin with ~.

    When they are more than `most_bytes`, those that were not used for longest are cleared away.
    """

    def __init__(self, folder: Path, most_bytes: int = MOST_BYTES) -> None:
        self._folder = folder
        self._most_bytes = most_bytes

    def read(self, key: str) -> bytes | None:
        """What was kept under `key`; None when that is nothing, or damaged."""
        try:
            path = (self._folder / key).expanduser()
            if not path.is_file() or path.stat().st_size > self._most_bytes:
                return None
            with path.open("rb") as file:
                digest, kept = file.read(_DIGEST_BYTES), file.read()
        except NO_PLACE:
            return None
        with suppress(OSError):  # another's, or on a file system for reading only
            os.utime(path)
        return kept if hashlib.sha256(kept).digest() == digest else None

    def keep(self, key: str, content: bytes) -> None:
        """`content` under `key`; where that cannot be, the log says so and no more happens."""
        if _DIGEST_BYTES + len(content) > self._most_bytes:
            _log.warning("The compiled model is not kept: %d bytes are too many", len(content))
            return
        try:
            write_cache(self._folder / key, hashlib.sha256(content).digest(), content)
        except NO_PLACE as error:
            _log.warning("The compiled model is not kept: %s", error)
        else:
            self._clear_away(self._folder.expanduser() / key)

    def _clear_away(self, newest: Path) -> None:
        used_bytes = newest.stat().st_size
        for size_bytes, path in _last_used_first(newest):
            used_bytes += size_bytes
            if used_bytes > self._most_bytes:
                with suppress(OSError):
                    path.unlink(missing_ok=True)


def _last_used_first(newest: Path) -> list[tuple[int, Path]]:
    """Size in bytes and path of the other files beside `newest` that a store has written."""
    found = []
    for path in newest.parent.iterdir():
        with suppress(OSError):  # another process clears away, too
            if _KEY.fullmatch(path.name) and path.is_file() and path != newest:
                status = path.stat()
                found.append((status.st_mtime, status.st_size, path))
    return [(size_bytes, path) for _, size_bytes, path in sorted(found, reverse=True)]
