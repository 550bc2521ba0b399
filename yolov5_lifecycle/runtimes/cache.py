"""Disk caches of timings and compiled models: their folder, files and keys."""

from __future__ import annotations

import hashlib
import logging
import os
import platform
import re
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path

from yolov5_lifecycle.atomic_file import atomic_write, open_itself, remove_abandoned_folders

MAX_BYTES = 1 << 30
NO_PLACE = (OSError, RuntimeError)
"""Errors of cache reads and writes; RuntimeError when there is no home folder."""

_DIGEST_BYTES = hashlib.sha256().digest_size
_KEY = re.compile(r"[0-9a-f]{64}")
# In /proc/cpuinfo: CPU model and features, on x86 and ARM.
_RELEVANT_FIELDS = ("model name", "flags", "Features", "CPU implementer", "CPU part")

_log = logging.getLogger(__name__)


def cache_folder(name: str) -> Path:
    """$XDG_CACHE_HOME/yolov5_lifecycle/`name`, default ~/.cache; ~ is not expanded."""
    cache = os.environ.get("XDG_CACHE_HOME", "")
    root = Path(cache if Path(cache).is_absolute() else "~/.cache")
    return root / "yolov5_lifecycle" / name


def write_cache(path: Path, *parts: bytes) -> None:
    """Write a file atomically, creating its folder if needed; `path` may begin with ~. Raises NO_PLACE.

    Removes what processes that were killed while writing there left unfinished.
    """
    path = path.expanduser()
    path.parent.mkdir(parents=True, exist_ok=True)
    remove_abandoned_folders(path.parent)
    atomic_write(path, *parts, is_durable=False)


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
    try:
        first, *_ = Path("/proc/cpuinfo").read_text(errors="replace").split("\n\n")
    except OSError:  # not Linux
        return f"{platform.machine()} {platform.processor()}"
    relevant = [line for line in first.splitlines() if line.startswith(_RELEVANT_FIELDS)]
    return "\n".join([platform.machine(), *relevant])
