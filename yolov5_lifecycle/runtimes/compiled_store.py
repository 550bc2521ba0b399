"""Compiled models on disk, so that each is made once."""

from __future__ import annotations

import hashlib
import logging
import os
from pathlib import Path

from yolov5_lifecycle.runtimes.whole_file import NO_PLACE, write_whole

_DIGEST_BYTES = hashlib.sha256().digest_size

_log = logging.getLogger(__name__)


class CompiledStore:
    """Bytes by a key that is a file's name, in a `folder` that may begin with ~.

    When there are more than `most_bytes`, those that were not used for longest are cleared away.
    """

    def __init__(self, folder: Path, most_bytes: int = 1 << 30) -> None:
        self._folder = folder
        self._most_bytes = most_bytes

    def read(self, key: str) -> bytes | None:
        """What was kept under `key`; None when that is nothing, or damaged."""
        try:
            path = (self._folder / key).expanduser()
            with path.open("rb") as file:
                digest, kept = file.read(_DIGEST_BYTES), file.read()
            os.utime(path)
        except NO_PLACE:
            return None
        return kept if hashlib.sha256(kept).digest() == digest else None

    def keep(self, key: str, content: bytes) -> None:
        """`content` under `key`; where that cannot be, the log says so and no more happens."""
        try:
            write_whole(self._folder / key, hashlib.sha256(content).digest(), content)
            self._clear_away()
        except NO_PLACE as error:
            _log.info("The compiled model is not kept: %s", error)

    def _clear_away(self) -> None:
        newest, *others = sorted(self._folder.expanduser().iterdir(), key=_last_use, reverse=True)
        used_bytes = newest.stat().st_size
        for path in others:
            used_bytes += path.stat().st_size
            if used_bytes > self._most_bytes:
                path.unlink(missing_ok=True)


def _last_use(path: Path) -> float:
    return path.stat().st_mtime
