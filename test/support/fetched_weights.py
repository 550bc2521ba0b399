"""`fetch_weights n` from a server on this machine."""

from __future__ import annotations

from pathlib import Path

from support.file_server import FileServer
from yolov5_lifecycle.checkpoints.locate import WeightsFile
from yolov5_lifecycle.commands.download import fetch

PATTERN = "/releases/yolov5{size}.pt"


def fetch_from(
    server: FileServer, folder: Path, *, model: str = "n", sha256: str = "", stall_s: float = 20
) -> WeightsFile:
    return fetch(model, folder, url=server.address + PATTERN, sha256=sha256, stall_s=stall_s)


def unfinished(folder: Path) -> Path:
    return folder / "yolov5n.partial.pt"
