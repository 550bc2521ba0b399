"""The files of the page, read once: a request never reaches the file system."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from importlib.resources import files

_TYPES: Mapping[str, str] = {
    ".html": "text/html; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".svg": "image/svg+xml",
    ".png": "image/png",
    ".webmanifest": "application/manifest+json",
}
PAGE, LOGIN = "index.html", "login.html"


@dataclass(frozen=True)
class PageFile:
    content: bytes
    media_type: str


def page_files() -> dict[str, PageFile]:
    """All files of the page by name. Raises FileNotFoundError if the installation lacks them."""
    folder = files("yolov5_lifecycle.ros.console").joinpath("page")
    found = {}
    for file in folder.iterdir():
        media_type = next((kind for ending, kind in _TYPES.items() if file.name.endswith(ending)), None)
        if media_type is not None and not file.name.startswith("."):
            found[file.name] = PageFile(file.read_bytes(), media_type)
    if missing := {PAGE, LOGIN} - found.keys():
        raise FileNotFoundError(
            f"{folder} lacks {', '.join(sorted(missing))}: install yolov5_lifecycle again"
        )
    return found
