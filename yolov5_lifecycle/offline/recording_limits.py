"""Limits for rosbags, which trusts the files that it reads."""

from __future__ import annotations

import resource
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any

from rosbags.rosbag2 import storage_mcap

from yolov5_lifecycle.folder_listing import entries

MAX_METADATA_BYTES = 16 << 20
MAX_INDEX_BYTES = 256 << 20
"""Of the index at the end of an MCAP file, which takes ten times as much memory. A terabyte has 30 MB."""
MAX_CHUNK_BYTES = 1 << 30
"""Of a decompressed chunk of messages. rosbag2 writes chunks of some megabytes."""
MAX_VALUE_BYTES = 1 << 30
"""Of one value in a database."""
_FREE_SHARE = 0.9
_FUNCTIONS = {"count", "min", "max"}
# Dependencies of rosbags.
_APSW: Any = import_module("apsw")
_LZ4: Any = import_module("lz4.frame")
_ZSTD: Any = vars(storage_mcap)["zstd"]  # in the standard library since Python 3.14, before that a package


class LimitError(ValueError):
    """A recording that exceeds a limit; the message has the value."""


def check_files(path: Path) -> None:
    """Raise LimitError unless the files of the recording at `path` are regular files or links to them.

    Reading a pipe would block forever, and metadata.yaml may name files in its folder as it likes.
    """
    for file in [path] if not path.is_dir() else sorted(entries(path)):
        is_storage = any(suffix in (".mcap", ".db3") for suffix in file.suffixes)
        is_read = is_storage or file.name == "metadata.yaml" or not file.is_dir()
        if is_read and file.exists() and not file.is_file():
            raise LimitError(f"{file.name} is not a regular file")
    metadata = path / "metadata.yaml"
    if metadata.is_file() and metadata.stat().st_size > MAX_METADATA_BYTES:
        raise LimitError(f"metadata.yaml has more than {MAX_METADATA_BYTES} bytes")


@contextmanager
def bounded_reading() -> Iterator[None]:
    """Within the context, rosbags checks databases with `check_database` and cannot fill the disk."""
    _APSW.connection_hooks.append(check_database)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    free = int(shutil.disk_usage(tempfile.gettempdir()).free * _FREE_SHARE)
    limits = [limit for limit in (free, soft, hard) if limit != resource.RLIM_INFINITY]
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (min(limits), hard))
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        _APSW.connection_hooks.remove(check_database)


def check_database(connection: Any) -> None:
    """Restrict queries to tables: views and computed columns could run forever or return any size."""
    connection.limit(_APSW.SQLITE_LIMIT_LENGTH, MAX_VALUE_BYTES)
    columns = "SELECT 1 FROM sqlite_master, pragma_table_xinfo(sqlite_master.name) WHERE hidden > 1"
    unusual = "SELECT 1 FROM sqlite_master WHERE type IN ('view', 'trigger') OR sql LIKE 'CREATE VIRTUAL%'"
    for query in (unusual, columns):
        if connection.execute(query).fetchone():
            raise LimitError(
                "the database has views, triggers or computed columns; a recording has only tables"
            )
    connection.authorizer = _authorized


def _authorized(action: int, _: str | None, name: str | None, __: str | None, view: str | None) -> int:
    is_foreign_function = action == _APSW.SQLITE_FUNCTION and (name or "").lower() not in _FUNCTIONS
    if view is not None or is_foreign_function or action == _APSW.SQLITE_RECURSIVE:
        return int(_APSW.SQLITE_DENY)
    return int(_APSW.SQLITE_OK)


def check_index(size_bytes: int) -> None:
    """Raise LimitError for an index of an MCAP file that is too large to be read."""
    if size_bytes > MAX_INDEX_BYTES:
        raise LimitError(f"the index has {size_bytes} bytes, expected at most {MAX_INDEX_BYTES}")


def check_chunks(storage: Any) -> None:
    """Raise LimitError if chunks of an MCAP file overlap, exceed the file or claim to be too large."""
    chunks = sorted(getattr(storage, "chunks", ()), key=lambda chunk: chunk.chunk_start_offset)
    end = 0
    for chunk in chunks:
        if chunk.uncompressed_size > MAX_CHUNK_BYTES:
            raise LimitError(f"a chunk claims {chunk.uncompressed_size} bytes, more than {MAX_CHUNK_BYTES}")
        if chunk.chunk_start_offset < end:
            raise LimitError("the index has overlapping chunks")
        end = chunk.chunk_start_offset + chunk.chunk_length
    if chunks and end > storage.path.stat().st_size:
        raise LimitError("the index has chunks behind the end of the file")


def unpacked(decompressor: Any, data: bytes, size: int) -> bytes:
    """`data` decompressed with `decompressor`; raises LimitError if longer than the expected `size` bytes."""
    content: bytes = decompressor.decompress(data, size + 1)
    if len(content) > size:
        raise LimitError(f"compressed data unpacks to more than the {size} bytes that were expected")
    return content


def _bounded(new_decompressor: Callable[[], Any]) -> Callable[[bytes, int], bytes]:
    return lambda data, size: unpacked(new_decompressor(), data, size)


# rosbags ignores the size that a chunk declares when it decompresses: a megabyte may become a thousand.
# It looks up the function in this table.
storage_mcap.DECOMPRESSORS["lz4"] = _bounded(_LZ4.LZ4FrameDecompressor)
storage_mcap.DECOMPRESSORS["zstd"] = _bounded(_ZSTD.ZstdDecompressor)


def unpacked_message(data: bytes) -> bytes:
    """Decompress a message compressed on its own; raises LimitError."""
    return unpacked(_ZSTD.ZstdDecompressor(), data, MAX_CHUNK_BYTES)
