"""Which folders of the package are mutated, and which tests must notice it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

from tools.mutants.mutant import Mutant, mutants_in

REPOSITORY = Path(__file__).parents[2]
PACKAGE = "yolov5_lifecycle"

TESTS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "settings": ("test/settings", "test/test_config.py", "test/test_settings_documents.py"),
        "streaming": ("test/streaming",),
        "tracking": ("test/tracking",),
        "detection": ("test/detection",),
        "checkpoints": ("test/checkpoints",),
        "models": ("test/models",),
        "spatial": ("test/spatial",),
        "ros/parameters": ("test/ros/parameters",),
    }
)
"""Folder of the package -> folders and files of tests."""


def test_files(folder: str) -> list[str]:
    """The files of tests for `folder`, relative to the repository."""
    paths = (REPOSITORY / path for path in TESTS[folder])
    files = (sorted(path.rglob("test_*.py")) if path.is_dir() else [path] for path in paths)
    return [str(file.relative_to(REPOSITORY)) for listed in files for file in listed]


def mutants_of(folder: str) -> list[Mutant]:
    """Every mutant of the modules in `folder`, in the order of the code."""
    modules = sorted((REPOSITORY / PACKAGE / folder).glob("*.py"))
    return [
        mutant for module in modules for mutant in mutants_in(f"{folder}/{module.name}", module.read_text())
    ]
