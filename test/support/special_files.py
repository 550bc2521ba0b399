"""Paths that are no plain file, or too much of one."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from pathlib import Path


def fifo(folder: Path, name: str) -> Path:
    path = folder / f"{name}.pt"
    os.mkfifo(path)
    return path


def link_to(target: str | Path) -> Callable[[Path, str], Path]:
    def make(folder: Path, name: str) -> Path:
        path = folder / f"{name}.pt"
        path.symlink_to(target)
        return path

    return make


def link_to_fifo(folder: Path, name: str) -> Path:
    os.mkfifo(folder.parent / "fifo")
    return link_to(folder.parent / "fifo")(folder, name)


def link_to_itself(folder: Path, name: str) -> Path:
    return link_to(f"{name}.pt")(folder, name)


def directory(folder: Path, name: str) -> Path:
    path = folder / f"{name}.pt"
    path.mkdir()
    return path


def sparse(folder: Path, name: str) -> Path:
    """3 GiB that take no room."""
    path = folder / f"{name}.safetensors"
    path.touch()
    os.truncate(path, 3 << 30)
    return path


def suffix(ending: str) -> Callable[[Path, str], Path]:
    def make(folder: Path, name: str) -> Path:
        path = folder / f"{name}{ending}"
        path.write_bytes(b"x")
        return path

    return make


SPECIAL: Mapping[str, tuple[Callable[[Path, str], Path], str]] = {
    "FIFO": (fifo, "expected a regular file"),
    "directory": (directory, "expected a regular file"),
    "link to a FIFO": (link_to_fifo, "expected a regular file"),
    "link to an endless device": (link_to("/dev/zero"), "expected a regular file"),
    "link to a directory": (link_to("/"), "expected a regular file"),
    "link to nothing": (link_to("/nonexistent"), "there is no such file"),
    "link to itself": (link_to_itself, "symbolic links"),
    "3 GiB": (sparse, "3221225472 bytes"),
    "ONNX by name": (suffix(".onnx"), "no ONNX model"),
    "TorchScript by name": (
        suffix(".torchscript"),
        "a TorchScript export, which holds a program: use the .pt",
    ),
    "TensorRT by name": (suffix(".ENGINE"), "a TensorRT export: use the .pt"),
    "no suffix": (suffix(""), "found ''"),
    "odd suffix": (suffix(".pt2"), "found '.pt2'"),
}
