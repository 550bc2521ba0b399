"""What to install when an import fails."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from types import MappingProxyType

from yolov5_lifecycle.printable import in_one_line

PIP_PACKAGES: Mapping[str, str] = MappingProxyType(
    {
        "annotated_types": "annotated-types",
        "cv2": "opencv-python-headless",
        "numpy": "numpy",
        "onnx": "onnx",
        "onnxruntime": "onnxruntime",
        "openvino": "openvino",
        "pydantic": "pydantic",
        "pydantic_core": "pydantic-core",
        "rosbags": "rosbags",
        "safetensors": "safetensors",
        "torch": "torch",
        "yaml": "pyyaml",
    }
)
"""Name for pip of each module that this package imports and that does not belong to ROS."""


def import_problem(error: ImportError) -> str:
    """The failed import, the Python used, and how to install what is missing."""
    return f"{sys.executable} cannot import what is needed: {in_one_line(str(error))}. {_remedy(error)}"


def _remedy(error: ImportError) -> str:
    module = (error.name or "").partition(".")[0]
    if not isinstance(error, ModuleNotFoundError) or module == __package__.partition(".")[0]:
        return "The installation is damaged or lacks a system library: install that package again."
    if module not in PIP_PACKAGES:
        return f"If '{module}' belongs to ROS, source ROS first: source /opt/ros/jazzy/setup.bash"
    remedy = f"Install it with {sys.executable} -m pip install {PIP_PACKAGES[module]}"
    if module == "cv2":
        remedy += ", or beside a ROS of apt with sudo apt install python3-opencv"
    return remedy
