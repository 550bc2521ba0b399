"""Remedies for failed imports: what to install."""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Mapping

from yolov5_lifecycle.printable import in_one_line, shell_command

_MODULES = (
    *("annotated_types", "apsw", "h11", "lz4", "numpy", "onnx", "onnxruntime", "openvino"),
    *("prometheus_client", "pycocotools", "pydantic", "pydantic_core", "rosbags"),
    *("safetensors", "scipy", "starlette", "torch", "uvicorn", "websockets"),
)
PIP_PACKAGES: Mapping[str, str] = {
    **{module: module.replace("_", "-") for module in _MODULES},
    "backports": "backports.zstd",
    "cv2": "opencv-python-headless",
    "yaml": "pyyaml",
}
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
    package = {"tf2_ros": "tf2_ros_py"}.get(ros_package, ros_package)
    return f"ros-{_distribution()}-{package.replace('_', '-')}"
