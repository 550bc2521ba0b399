"""Which folders of the package are mutated, and which tests must notice it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

REPOSITORY = Path(__file__).parents[2]
PACKAGE = "yolov5_lifecycle"

TESTS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "settings": ("test/settings", "test/test_config.py", "test/test_settings_documents.py"),
        "streaming": ("test/streaming",),
        "tracking": ("test/tracking",),
        "detection": ("test/detection", "test/test_public_api.py"),
        "checkpoints": ("test/checkpoints",),
        "models": ("test/models",),
        "spatial": ("test/spatial",),
        "ros/parameters": ("test/ros/parameters",),
    }
)
"""Folder of the package -> folders and files of tests."""


def files_of_tests(folder: str) -> list[str]:
    """The files of tests for `folder`, relative to the repository."""
    paths = (REPOSITORY / path for path in TESTS[folder])
    files = (sorted(path.rglob("test_*.py")) if path.is_dir() else [path] for path in paths)
    return [str(file.relative_to(REPOSITORY)) for listed in files for file in listed]
