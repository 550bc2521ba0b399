"""Things that are no regular file, or not a small one, where a file of the cache is expected."""

from __future__ import annotations

import os
import socket
from collections.abc import Callable, Mapping
from pathlib import Path


def _socket(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as server:
        folder = os.open(path.parent, os.O_RDONLY)
        server.bind(f"/proc/self/fd/{folder}/{path.name}")  # a socket's own path may have 107 bytes at most
        os.close(folder)


def _huge(path: Path) -> None:
    """3 GiB that take up no space."""
    path.touch()
    os.truncate(path, 3 << 30)


def _link_to_fifo(path: Path) -> None:
    os.mkfifo(path.with_name("fifo"))
    path.symlink_to("fifo")


def _unreadable(path: Path) -> None:
    path.write_bytes(b"x")
    path.chmod(0)


SPECIAL_CACHE_FILES: Mapping[str, Callable[[Path], object]] = {
    "FIFO": os.mkfifo,
    "link to a FIFO": _link_to_fifo,
    "link to an endless device": lambda path: path.symlink_to("/dev/zero"),
    "link to a folder": lambda path: path.symlink_to("/"),
    "link to itself": lambda path: path.symlink_to(path),
    "socket": _socket,
    "3 GiB": _huge,
    "unreadable": _unreadable,
    "nested lists": lambda path: path.write_bytes(b"[" * 4000),
}
