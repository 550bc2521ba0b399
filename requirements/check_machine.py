"""Says, before anything is installed, whether this machine can hold the environment; runs on any Python 3."""

import importlib.util
import os
import shutil
import sys
import sysconfig

APT_LINE = "sudo apt install git make g++ python3-venv python3-dev"
# The newest Python with wheels: rclpy's for the tested set, numpy 1.26's for the one of apt.
NEWEST = {"tested": (3, 13), "apt": (3, 12)}
OLDEST = (3, 10)


def python_problem(version, package_set):
    """What is wrong with Python `version`, a pair of numbers, for the set of packages; "" when nothing is."""
    newest = NEWEST[package_set]
    if OLDEST <= version <= newest:
        return ""
    return "Python %d.%d to %d.%d is needed for the set '%s', found %d.%d (%s). Choose another: make PYTHON=python3.12 ..." % (
        *OLDEST,
        *newest,
        package_set,
        *version,
        sys.executable,
    )


def missing_tools():
    """What the machine lacks of a compiler, Python's headers and its module for virtual environments, in words."""
    header = os.path.join(sysconfig.get_paths()["include"], "Python.h")
    found = {
        "a C++ compiler (c++ or g++)": os.environ.get("CXX") or shutil.which("c++") or shutil.which("g++"),
        "the headers of this Python (%s)" % header: os.path.isfile(header),
        "Python's ensurepip module": importlib.util.find_spec("ensurepip"),
    }
    return [name for name, there in found.items() if not there]


def main(package_set):
    """Exit status: 0 when the environment can be made, else 1 with the reason on stderr."""
    problem = python_problem(sys.version_info[:2], package_set)
    missing = missing_tools()
    if missing:
        problem += "\nMissing: %s. On Debian and Ubuntu: %s" % (", ".join(missing), APT_LINE)
    if problem:
        sys.stderr.write(problem.strip() + "\n")
    return 1 if problem else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
