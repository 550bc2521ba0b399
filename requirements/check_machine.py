"""Says, before anything is installed, whether this machine can hold the environment; runs on Python 3.6."""

import importlib.util
import os
import re
import shutil
import sys
import sysconfig
from typing import List, Tuple

APT_LINE = "sudo apt install git make g++ python3-venv python3-dev"
# The newest Python with wheels: rclpy's, or numpy 1.26's for the set of apt.
NEWEST = {"tested": (3, 13), "apt": (3, 12), "kilted": (3, 13)}
OLDEST = (3, 10)
# In such paths the messages have been built; a comma breaks -Wl,-rpath, and rosidl reads paths as ASCII.
BUILDABLE_PATH = r"[A-Za-z0-9/._+@=~ -]*"
# What the demo needs while it is being installed; the tests need as much again.
NEEDED_BYTES = 2 * 10**9


def python_problem(version: Tuple[int, int], package_set: str) -> str:
    """What is wrong with Python `version`, a pair of numbers, for the set of packages; "" when nothing is."""
    newest = NEWEST[package_set]
    if OLDEST <= version <= newest:
        return ""
    return (
        f"Python {OLDEST[0]}.{OLDEST[1]} to {newest[0]}.{newest[1]} is needed for the set '{package_set}', "
        f"found {version[0]}.{version[1]} ({sys.executable}). Choose another: make PYTHON=python3.12 ..."
    )


def missing_tools(compiles: bool) -> List[str]:
    """What the machine lacks to make a virtual environment and, if it `compiles`, the messages; in words."""
    header = os.path.join(sysconfig.get_paths()["include"], "Python.h")
    compilers = {
        "a C++ compiler (c++ or g++)": os.environ.get("CXX") or shutil.which("c++") or shutil.which("g++"),
        f"the headers of this Python ({header})": os.path.isfile(header),
    }
    found = {"Python's ensurepip module": importlib.util.find_spec("ensurepip")}
    return [name for name, there in {**(compilers if compiles else {}), **found}.items() if not there]


def path_problem(folder: str) -> str:
    """Why the messages cannot be built below the path `folder`, and what to do; "" when they can."""
    if re.fullmatch(BUILDABLE_PATH, folder):
        return ""
    strange = "".join(sorted(set(re.sub(BUILDABLE_PATH, "", folder))))
    return (
        f"Move this folder to a path without {strange!a}, such as ~/yolov5_lifecycle: ROS messages can "
        f"be built only in a path of letters A to Z, digits, blanks and / . _ + @ = ~ -, found {folder!a}."
    )


def folder_problem(folder: str, writable: bool, free_bytes: int) -> str:
    """Why `folder`, on a disk with `free_bytes` free, cannot hold the environment; "" when it can."""
    if not writable:
        return f"Clone the repository into a folder of your own: this user cannot write to {folder!a}."
    if free_bytes < NEEDED_BYTES:
        return (
            f"Free {NEEDED_BYTES / 1e9:.0f} GB of disk space; 'make clean' removes an older environment. "
            f"{folder!a} has {free_bytes / 1e9:.1f} GB free."
        )
    return ""


def machine_problems(package_set: str, folder: str, compiles: bool) -> List[str]:
    """Why the environment, for which the machine `compiles` the messages, cannot be made in `folder`."""
    missing = missing_tools(compiles)
    problems = [
        python_problem((sys.version_info[0], sys.version_info[1]), package_set),
        f"Missing: {', '.join(missing)}. On Debian and Ubuntu: {APT_LINE}" if missing else "",
        path_problem(folder) if compiles else "",
        folder_problem(folder, os.access(folder, os.W_OK), shutil.disk_usage(folder).free),
    ]
    return [problem for problem in problems if problem]


def main(package_set: str, interfaces_wheel: str = "") -> int:
    """Exit status: 0 when the environment can be made, else 1 with the reasons on stderr.

    With `interfaces_wheel`, the messages already compiled, no compiler is needed.
    """
    problems = machine_problems(package_set, os.getcwd(), compiles=not interfaces_wheel)
    sys.stderr.writelines(problem + "\n" for problem in problems)
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
