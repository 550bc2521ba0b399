"""A colcon workspace with this package, as a user has it."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

REPOSITORY = Path(__file__).parents[2]
SUPPORT = Path(__file__).parent
SUPPORT_PATH = {"PYTHONPATH": f"{SUPPORT.parent}:{REPOSITORY}"}
"""Environment of a child process that imports the folder `support`."""
PACKAGE = "yolov5_lifecycle"
COMMANDS = (
    "calibrate",
    "camera",
    "console",
    "convert",
    "demo",
    "detect_bag",
    "detector",
    "evaluate",
    "fetch_weights",
)


def published_files() -> list[Path]:
    """What a clone of the working tree would hold, relative to the repository."""
    listing = subprocess.run(
        ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
        cwd=REPOSITORY,
        capture_output=True,
        check=True,
    )
    names = listing.stdout.decode().split("\0")
    return [Path(name) for name in names if (REPOSITORY / name).is_file()]


def build_workspace(folder: Path) -> None:
    """Copy the package into `folder`/src and build it."""
    for file in published_files():
        copy = folder / "src" / PACKAGE / file
        copy.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(REPOSITORY / file, copy)
    build = subprocess.run(
        [Path(sys.executable).with_name("colcon"), "build"],
        cwd=folder,
        env=os.environ | {"COLCON_HOME": str(folder / "home")},
        capture_output=True,
        text=True,
    )
    assert build.returncode == 0, build.stdout + build.stderr
