"""YOLOv5 object detection as a ROS 2 lifecycle node, and in Python without ROS."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from yolov5_lifecycle.detection.detections import Detections
    from yolov5_lifecycle.detection.detector import Detector
    from yolov5_lifecycle.detection.python_api import load_model

__all__ = ["Detections", "Detector", "load_model"]

_MODULES = {"Detections": "detections", "Detector": "detector", "load_model": "python_api"}


def __getattr__(name: str) -> object:
    """Import a public name on first use: a command prepares its process after importing this package."""
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.detection.{_MODULES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
