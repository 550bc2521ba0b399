"""Imports point one way, and only ros/ knows ROS."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest
from colcon_workspace import REPOSITORY

PACKAGE = REPOSITORY / "yolov5_lifecycle"
ROS_MODULES = {
    "rclpy",
    "ament_index_python",
    "builtin_interfaces",
    "diagnostic_msgs",
    "lifecycle_msgs",
    "rcl_interfaces",
    "sensor_msgs",
    "std_msgs",
    "vision_msgs",
}
# A module may import modules of a lower rank; those of one rank only what is named in PEERS.
RANKS = [
    {
        "architecture",
        "detections",
        "images",
        "letterbox",
        "suggestion",
        "empty_frames",
        "frame_balance",
        "rate",
        "package_path",
        "progress",
        "heap",
        "setting",
        "one_line",
        "scene",
        "download",
        "whole_file",
    },
    {
        "memory",
        "network",
        "boxes",
        "class_filter",
        "settings",
        "image_encoding",
        "raw_image",
        "picture_source",
        "found_objects",
    },
    {"model", "compressed_image", "playback"},
    {"parameter_file", "selection", "message_pictures"},
    {"annotate", "checkpoint_archive", "confinement", "pickle_operations", "yaml_architecture", "runtimes"},
    {"pickled_names"},
    {"pickle_program"},
    {"pickled_module"},
    {"module_settings"},
    {"checkpoint", "safetensors_file"},
    {"weights", "detector"},
    {"worker", "convert", "preparation"},
    {"fetch_weights", "offline"},
    {"ros"},
]
# What a user starts: the nodes and the commands that work like them; and what makes a detector of settings.
EDGE = {"ros", "fetch_weights", "offline", "parameter_file", "preparation", "selection"}
PEERS = {("ros", "ros"), ("runtimes", "runtimes"), ("offline", "offline")}


def _imports(path: Path) -> set[str]:
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return names


def _modules() -> dict[Path, str]:
    """Every source file and the name, below the package, that stands for it in RANKS."""
    return {
        path: path.relative_to(PACKAGE).parts[0].removesuffix(".py")
        for path in sorted(PACKAGE.rglob("*.py"))
        if path != PACKAGE / "__init__.py"
    }


@pytest.mark.parametrize(
    ("path", "name"), [pytest.param(*item, id=str(item[0].name)) for item in _modules().items()]
)
def test_imports_point_from_higher_to_lower_rank(path: Path, name: str) -> None:
    rank = {module: index for index, modules in enumerate(RANKS) for module in modules}
    assert name in rank, f"say in RANKS where {name} belongs"
    imported = {part.split(".")[1] for part in _imports(path) if part.startswith("yolov5_lifecycle.")}
    wrong = {other for other in imported if rank[other] >= rank[name] and (name, other) not in PEERS}
    assert not wrong, f"{path.name} must not import {wrong}"


@pytest.mark.parametrize(
    ("path", "name"), [pytest.param(*item, id=str(item[0].name)) for item in _modules().items()]
)
def test_settings_are_imported_at_the_edge_alone(path: Path, name: str) -> None:
    assert name in EDGE or not any(part.startswith("yolov5_lifecycle.settings") for part in _imports(path))


def test_everything_outside_ros_imports_without_ros() -> None:
    names = [
        ".".join(("yolov5_lifecycle", *path.relative_to(PACKAGE).with_suffix("").parts))
        for path, name in _modules().items()
        if name != "ros"
    ]
    block = f"import sys; sys.modules.update(dict.fromkeys({sorted(ROS_MODULES)!r}))"
    program = f"{block}; import importlib; [importlib.import_module(name) for name in {names!r}]"
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
