"""Says, before anything is installed, whether this machine can hold the environment; runs on Python 3.6."""

import importlib.util
import os
import shutil
import sys
import sysconfig
from typing import List, Tuple

APT_LINE = "sudo apt install git make g++ python3-venv python3-dev"
# The newest Python with wheels: rclpy's for the tested set, numpy 1.26's for the one of apt.
NEWEST = {"tested": (3, 13), "apt": (3, 12)}
OLDEST = (3, 10)


def python_problem(version: Tuple[int, int], package_set: str) -> str:
    """What is wrong with Python `version`, a pair of numbers, for the set of packages; "" when nothing is."""
    newest = NEWEST[package_set]
    if OLDEST <= version <= newest:
        return ""
    return (
        f"Python {OLDEST[0]}.{OLDEST[1]} to {newest[0]}.{newest[1]} is needed for the set '{package_set}', "
        f"found {version[0]}.{version[1]} ({sys.executable}). Choose another: make PYTHON=python3.12 ..."
    )


def missing_tools() -> List[str]:
    """What the machine lacks to build the messages and to make a virtual environment, in words."""
    header = os.path.join(sysconfig.get_paths()["include"], "Python.h")
    found = {
        "a C++ compiler (c++ or g++)": os.environ.get("CXX") or shutil.which("c++") or shutil.which("g++"),
        f"the headers of this Python ({header})": os.path.isfile(header),
        "Python's ensurepip module": importlib.util.find_spec("ensurepip"),
    }
    return [name for name, there in found.items() if not there]


def main(package_set: str) -> int:
    """Exit status: 0 when the environment can be made, else 1 with the reason on stderr."""
    problem = python_problem((sys.version_info[0], sys.version_info[1]), package_set)
    missing = missing_tools()
    if missing:
        problem += f"\nMissing: {', '.join(missing)}. On Debian and Ubuntu: {APT_LINE}"
    if problem:
        sys.stderr.write(problem.strip() + "\n")
    return 1 if problem else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
