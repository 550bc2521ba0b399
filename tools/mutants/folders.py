"""Which folders of the package are mutated, and which tests must notice it."""

from __future__ import annotations

import argparse
import os
import sys
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


def parser() -> argparse.ArgumentParser:
    """The argument parser."""
    parser = argparse.ArgumentParser(
        prog="make mutants", description="Change the code in small ways; a test must notice each."
    )
    parser.add_argument(
        "--only",
        nargs="+",
        choices=TESTS,
        default=[*TESTS],
        metavar="FOLDER",
        help=f"some of: {', '.join(TESTS)}",
    )
    parser.add_argument("--count", type=int, default=40, help="mutants per folder; default: %(default)s")
    parser.add_argument(
        "--all", dest="count", action="store_const", const=sys.maxsize, help="every mutant: many hours"
    )
    parser.add_argument("--seed", type=int, default=0, help="another seed takes another sample")
    parser.add_argument(
        "--jobs", type=int, default=len(os.sched_getaffinity(0)), help="processes; default: one per core"
    )
    return parser
