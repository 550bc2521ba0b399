"""Disk cache of compiled models."""

from __future__ import annotations

import hashlib
import logging
import os
import re
import stat
from contextlib import suppress
from pathlib import Path

from yolov5_lifecycle.runtimes.cache_folder import NO_PLACE, read_cache, write_cache

MAX_BYTES = 1 << 30

_DIGEST_BYTES = hashlib.sha256().digest_size
_KEY = re.compile(r"[0-9a-f]{64}")

_log = logging.getLogger(__name__)


class CompiledStore:
    """Bytes by a key of 64 hexadecimal digits, one file each, in a `folder` that may begin with ~.

    Beyond `max_bytes` in total, the least recently used files are evicted.
    """

    def __init__(self, folder: Path, max_bytes: int = MAX_BYTES) -> None:
        self._folder = folder
        self._max_bytes = max_bytes

    def read(self, key: str) -> bytes | None:
        """The content cached under `key`; None when it is missing or damaged."""
        path = self._folder / key
        found = read_cache(path, self._max_bytes, head_bytes=_DIGEST_BYTES)
        if found is None:
            return None
        digest, kept = found
        with suppress(*NO_PLACE):  # owned by another user, or on a read-only file system
            os.utime(path.expanduser(), follow_symlinks=False)
        return kept if hashlib.sha256(kept).digest() == digest else None

    def keep(self, key: str, content: bytes) -> None:
        """Cache `content` under `key`; a failure is only logged."""
        if _DIGEST_BYTES + len(content) > self._max_bytes:
            _log.warning("The compiled model is not kept: %d bytes are too many", len(content))
            return
        try:
            write_cache(self._folder / key, hashlib.sha256(content).digest(), content)
        except NO_PLACE as error:
            _log.warning("The compiled model is not kept: %s", error)
            return
        with suppress(*NO_PLACE):  # another process may evict at the same time
            self._evict(self._folder.expanduser() / key)

    def _evict(self, newest: Path) -> None:
        used_bytes = newest.stat().st_size
        for size_bytes, path in _last_used_first(newest):
            used_bytes += size_bytes
            if used_bytes > self._max_bytes:
                with suppress(OSError):
                    path.unlink(missing_ok=True)


def _last_used_first(newest: Path) -> list[tuple[int, Path]]:
    """Size in bytes and path of the other cached files next to `newest`, most recently used first."""
    found = []
    for path in newest.parent.iterdir():
        with suppress(OSError):  # another process may evict at the same time
            status = path.lstat()
            if _KEY.fullmatch(path.name) and stat.S_ISREG(status.st_mode) and path != newest:
                found.append((status.st_mtime, status.st_size, path))
    return [(size_bytes, path) for _, size_bytes, path in sorted(found, reverse=True)]
