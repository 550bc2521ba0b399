"""The user's cache of what was measured: small files, each written whole."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

from yolov5_lifecycle.atomic_file import atomic_write, remove_abandoned_folders
from yolov5_lifecycle.input_file import read_regular_file

MAX_BYTES = 1 << 20
NO_PLACE = (OSError, RuntimeError)
"""Errors of a cache that cannot be used; RuntimeError when there is no home folder."""


def cache_folder() -> Path:
    """$XDG_CACHE_HOME/yolov5_lifecycle/choices, default ~/.cache; ~ is not expanded."""
    cache = os.environ.get("XDG_CACHE_HOME", "")
    root = Path(cache if Path(cache).is_absolute() else "~/.cache")
    return root / "yolov5_lifecycle" / "choices"


def write_cache(path: Path, content: object) -> None:
    """Write `content` as JSON, creating the folder if needed; `path` may begin with ~. Raises NO_PLACE.

    Removes what processes that were killed while writing there left unfinished.
    """
    path = path.expanduser()
    path.parent.mkdir(parents=True, exist_ok=True)
    remove_abandoned_folders(path.parent)
    atomic_write(path, json.dumps(content).encode(), is_durable=False)


<<<<<<< HEAD
def read_cache(path: Path) -> Any:
    """What was written at `path`, which may begin with ~; None if it is missing or damaged."""
=======
class DiskCache:
    """Bytes by a key of 64 hexadecimal digits, one file each, in a `folder` that may begin with ~.

    Beyond `max_bytes` in total, the least recently used files are evicted.
    """

    def __init__(self, folder: Path, max_bytes: int = MAX_BYTES) -> None:
        self.folder = folder
        self._max_bytes = max_bytes

    def read(self, key: str) -> bytes | None:
        """The content cached under `key`; None when it is missing or damaged."""
        try:
            path = (self.folder / key).expanduser()
            with open(path, "rb", opener=open_itself) as file:
                digest, kept = file.read(_DIGEST_BYTES), file.read(self._max_bytes)
        except NO_PLACE:
            return None
        with suppress(OSError):  # owned by another user, or on a read-only file system
            os.utime(path)
        return kept if hashlib.sha256(kept).digest() == digest else None

    def keep(self, key: str, content: bytes) -> None:
        """Cache `content` under `key`; a failure is only logged."""
        if _DIGEST_BYTES + len(content) > self._max_bytes:
            _log.warning(
                "Not cached, because its %d bytes exceed the limit: %s", len(content), self.folder / key
            )
            return
        try:
            write_cache(self.folder / key, hashlib.sha256(content).digest(), content)
        except NO_PLACE as error:
            _log.warning(
                "Not cached in %s: %s. Give this user the right to write it, "
                "or set XDG_CACHE_HOME to another folder: without a cache, each start compiles the model and "
                "compares the runtimes again.",
                self.folder,
                error,
            )
            return
        with suppress(*NO_PLACE):  # another process may evict at the same time
            self._evict(self.folder.expanduser() / key)

    def _evict(self, newest: Path) -> None:
        """Remove the other files used longest ago, until all take up at most `max_bytes`."""
        found = []
        for path in newest.parent.iterdir():
            with suppress(OSError):  # another process may evict at the same time
                status = path.lstat()
                if _KEY.fullmatch(path.name) and path != newest:
                    found.append((status.st_mtime, status.st_size, path))
        used_bytes = newest.stat().st_size
        for _, size_bytes, path in sorted(found, reverse=True):
            used_bytes += size_bytes
            if used_bytes > self._max_bytes:
                with suppress(OSError):
                    path.unlink()


def installed_build(package: str) -> str | None:
    """File and modification time of what `import package` would load; differs between versions.

    Independent of the distribution: onnxruntime may come from onnxruntime-gpu. None when the package is
    missing or only a folder of that name.
    """
    spec = find_spec(package)
    if spec is None or spec.origin is None:
        return None
    return f"{spec.origin} {Path(spec.origin).stat().st_mtime_ns}"


def processor() -> str:
    """Architecture, model name (if available) and features of the CPU."""
>>>>>>> r-sup2
    try:
        return json.loads(read_regular_file(path.expanduser(), MAX_BYTES))
    except (*NO_PLACE, ValueError):
        return None
