"""The version of this package."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, version


def version_line(command: str) -> str:
    """Output of `command --version`, without the line break."""
    try:
        return f"{command} {version('yolov5_lifecycle')} (yolov5_lifecycle)"
    except PackageNotFoundError:
        return f"{command}, of a yolov5_lifecycle that is not installed and so has no version"
