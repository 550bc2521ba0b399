"""A colcon workspace with this package, as a user has it."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from fnmatch import fnmatchcase
from pathlib import Path

REPOSITORY = Path(__file__).parents[2]
SUPPORT = Path(__file__).parent
SUPPORT_PATH = {"PYTHONPATH": f"{SUPPORT.parent}:{REPOSITORY}"}
"""Environment of a child process that imports the folder `support`."""
PACKAGE = "yolov5_lifecycle"
COMMANDS = (
    "calibrate",
    "camera",
    "collected",
    "console",
    "convert",
    "demo",
    "detect_bag",
    "detector",
    "doctor",
    "evaluate",
    "fetch_weights",
)


def published_files() -> list[Path]:
    """What a clone of the working tree would hold, relative to the repository.

    git is not asked: a release's archive has no history, and git refuses the clone of another user.
    """
    patterns = [".git", *(line.rstrip("/") for line in (REPOSITORY / ".gitignore").read_text().splitlines())]
    found: list[Path] = []
    for folder, folders, names in os.walk(REPOSITORY):
        folders[:] = [name for name in folders if not _matches(name, patterns)]
        found += [Path(folder, name) for name in names if not _matches(name, patterns)]
    return [file.relative_to(REPOSITORY) for file in found if file.is_file()]


def _matches(name: str, patterns: list[str]) -> bool:
    return any(fnmatchcase(name, pattern) for pattern in patterns)


def clone(folder: Path) -> Path:
    """Those files in the new `folder`."""
    for file in published_files():
        copy = folder / file
        copy.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(REPOSITORY / file, copy)
    return folder


def build_workspace(folder: Path) -> None:
    """Copy the package into `folder`/src and build it."""
    clone(folder / "src" / PACKAGE)
    build = subprocess.run(
        [Path(sys.executable).with_name("colcon"), "build"],
        cwd=folder,
        env=os.environ | {"COLCON_HOME": str(folder / "home")},
        capture_output=True,
        text=True,
    )
    assert build.returncode == 0, build.stdout + build.stderr
