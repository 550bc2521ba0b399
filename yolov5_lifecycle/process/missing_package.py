"""Remedies for failed imports: what to install."""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Mapping
from types import MappingProxyType

from yolov5_lifecycle.printable import in_one_line, shell_command

PIP_PACKAGES: Mapping[str, str] = MappingProxyType(
    {
        "annotated_types": "annotated-types",
        "apsw": "apsw",
        "backports": "backports.zstd",
        "cv2": "opencv-python-headless",
        "h11": "h11",
        "lz4": "lz4",
        "matplotlib": "matplotlib",
        "numpy": "numpy",
        "onnx": "onnx",
        "onnxruntime": "onnxruntime",
        "openvino": "openvino",
        "prometheus_client": "prometheus-client",
        "pycocotools": "pycocotools",
        "pydantic": "pydantic",
        "pydantic_core": "pydantic-core",
        "rosbags": "rosbags",
        "safetensors": "safetensors",
        "scipy": "scipy",
        "starlette": "starlette",
        "torch": "torch",
        "uvicorn": "uvicorn",
        "websockets": "websockets",
        "yaml": "pyyaml",
    }
)
"""pip name of each module that this package imports and that does not belong to ROS."""
_APT_PACKAGES = {"cv2": "python3-opencv", "scipy": "python3-scipy"}


def import_problem(error: ImportError) -> str:
    """The failed import, the Python used, and how to install what is missing."""
    return f"{sys.executable} cannot import what is needed: {in_one_line(str(error))}. {_remedy(error)}"


def absence_of(module: str) -> str:
    """Import the optional `module`; return "", or why that failed and what to do."""
    try:
        importlib.import_module(module)
    except ImportError as error:
        return import_problem(error)
    return ""


def _remedy(error: ImportError) -> str:
    """How to install what is missing or damaged."""
    module = (error.name or "").partition(".")[0]
    if not isinstance(error, ModuleNotFoundError) or module == __package__.partition(".")[0]:
        return "The installation is damaged or lacks a system library: install that package again."
    if module not in PIP_PACKAGES:
        return (
            f"If '{module}' belongs to ROS, source ROS first: source /opt/ros/{_distribution()}/setup.bash. "
            f"If it is still missing then: sudo apt install {apt_package_of(module)}"
        )
    remedy = f"Install it with {shell_command(sys.executable, '-m', 'pip', 'install', PIP_PACKAGES[module])}"
    if module in _APT_PACKAGES:
        remedy += f", or for a ROS from apt with sudo apt install {_APT_PACKAGES[module]}"
    return remedy


def _distribution() -> str:
    """Name of the ROS distribution that this environment has sourced; without one jazzy."""
    return os.environ.get("ROS_DISTRO", "jazzy")


def apt_package_of(ros_package: str) -> str:
    """The package of apt that holds `ros_package`, in the distribution that this environment has sourced."""
    return f"ros-{_distribution()}-{ros_package.replace('_', '-')}"
