"""Compiles the messages with CMake into one wheel with what Python needs, laid out like those of ROS."""

import os
import shlex
import shutil
import subprocess
import sys
import sysconfig
from importlib.metadata import version
from pathlib import Path

from setuptools import Extension, setup
from setuptools.command.build_ext import build_ext

PACKAGES = ("vision_msgs", "bond")
# The compiled messages contain those of these packages and fit no other minor version.
LINKED = ("ros-builtin-interfaces", "ros-geometry-msgs", "ros-rosidl-default-runtime", "ros-std-msgs")
SHARED = ("share/*/package.xml", "share/*/msg/*", "share/ament_index/resource_index/*/*")
BUILD_MACHINE = "parent_prefix_path"  # an index of the build machine's folders, of no use elsewhere


def compile_messages(package: str, build: Path, prefix: Path) -> None:
    """Compile one package of messages in the folder `build` and install it below `prefix`."""
    programs = Path(sysconfig.get_path("scripts"))
    cmake = programs / "cmake"
    if not cmake.exists():
        sys.exit(
            f"{cmake} is missing: install requirements/interfaces.txt first, or run 'make interfaces-wheels'."
        )
    # The compiler writes paths of sources into the libraries; the same bytes must come out of every folder.
    flags = shlex.join(f"-ffile-prefix-map={folder}=." for folder in (build.resolve(), sys.prefix))
    definitions = {
        "CMAKE_BUILD_TYPE": "Release",
        "BUILD_TESTING": "OFF",
        "CMAKE_C_FLAGS": flags,
        "CMAKE_CXX_FLAGS": flags,
        "CMAKE_INSTALL_PREFIX": prefix.resolve(),
        "CMAKE_MAKE_PROGRAM": programs / "ninja",
        "CMAKE_PREFIX_PATH": sys.prefix,
        "CMAKE_SKIP_RPATH": "ON",  # folders of the build machine, whose lengths would remain in the libraries
        "Python3_EXECUTABLE": sys.executable,
    }
    configure = [cmake, "-S", package, "-B", build, "-G", "Ninja", "--log-level=WARNING"]
    defined = [f"-D{name}={value}" for name, value in definitions.items()]
    environment = os.environ | {"AMENT_PREFIX_PATH": sys.prefix}  # where rosidl looks for its generators
    for command in (
        [*configure, *defined],
        [cmake, "--build", build],
        [cmake, "--install", build, "--strip"],
    ):
        subprocess.run(command, env=environment, check=True)


def files_by_folder(prefix: Path) -> list[tuple[str, list[str]]]:
    """The libraries and shared files below `prefix`: each folder's path in an environment, and its files."""
    files = [file for pattern in ("lib/*.so", *SHARED) for file in sorted(prefix.glob(pattern))]
    kept = [file for file in files if BUILD_MACHINE not in file.parts]
    folders = sorted({file.parent for file in kept})
    return [
        (str(folder.relative_to(prefix)), [str(file) for file in kept if file.parent == folder])
        for folder in folders
    ]


class MessagesBuild(build_ext):
    """Builds the packages of messages in place of an extension module."""

    def run(self) -> None:
        """Compile all packages, and hand their files to the steps that make a wheel."""
        build = Path(self.build_temp)
        prefix = build / "installed"
        for package in PACKAGES:
            compile_messages(package, build / package, prefix)
            (modules,) = prefix.glob(f"**/site-packages/{package}")
            # The generated C sources have been compiled; bytecode is written where the wheel is installed.
            ignored = shutil.ignore_patterns("*.c", "__pycache__")
            shutil.copytree(modules, Path(self.build_lib, package), ignore=ignored, dirs_exist_ok=True)
        self.distribution.data_files = files_by_folder(prefix)


setup(
    packages=[],
    ext_modules=[Extension("messages", [])],  # makes the wheel one for this Python and this kind of processor
    cmdclass={"build_ext": MessagesBuild},
    install_requires=["numpy", *(f"{name}~={version(name)}" for name in LINKED)],
)
