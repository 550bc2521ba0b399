"""What a user gets: the colcon build, the installed commands, declared, pinned and Pixi's dependencies."""

from __future__ import annotations

import ast
import os
import re
import runpy
import subprocess
import sys
import sysconfig
from collections.abc import Iterator
from importlib.metadata import Distribution, distribution, distributions
from pathlib import Path
from xml.etree import ElementTree

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from support.clean_environment import pins
from support.colcon_workspace import COMMANDS, PACKAGE, REPOSITORY, published_files

from yolov5_lifecycle.process.missing_package import PIP_PACKAGES

SHARED_FOLDERS = ("config", "launch", "weights")
TYPED_COMMANDS = {"ros2launch"}
"""Nobody imports it: it is where `ros2` has the word from that starts the launch files."""
MODULE_OF_APT = {"python3-numpy": "numpy", "python3-opencv": "cv2", "python3-yaml": "yaml"}
MODULE_OF_ROS = {"tf2_ros_py": "tf2_ros"}
MODULE_OF_PIP = {"opencv-python-headless": "cv2", "pyyaml": "yaml", "backports.zstd": "backports"}
OF_CONDA = {"torch": "pytorch", "opencv-python-headless": "py-opencv"}
SETS = {
    "tested": "constraints.txt",
    "apt": "constraints-apt.txt",
    "kilted": "constraints-kilted.txt",
}


@pytest.fixture
def prefix(workspace: Path) -> Path:
    return workspace / "install" / PACKAGE


def in_built_workspace(workspace: Path, command: str) -> str:
    """Output of a shell command after the workspace has been sourced."""
    script = f"set -e; . install/local_setup.bash; cd /; {command}"
    run = subprocess.run(["bash", "-c", script], cwd=workspace, capture_output=True, text=True)
    assert run.returncode == 0, run.stdout + run.stderr
    return run.stdout


@pytest.mark.long
def test_colcon_builds_this_package_alone_with_its_executables_where_ros2_run_looks(prefix: Path) -> None:
    assert [folder.name for folder in prefix.parent.iterdir() if folder.is_dir()] == [PACKAGE]
    executables = list((prefix / "lib" / PACKAGE).iterdir())
    assert sorted(file.name for file in executables) == sorted(COMMANDS)
    assert all(os.access(file, os.X_OK) for file in executables)


def test_the_build_has_every_module_and_file_of_the_package(prefix: Path) -> None:
    share = prefix / "share"
    assert (share / "ament_index" / "resource_index" / "packages" / PACKAGE).is_file()
    assert (share / PACKAGE / "package.xml").is_file()
    for folder in SHARED_FOLDERS:
        files = [file for file in published_files() if file.parts[0] == folder and len(file.parts) == 2]
        assert {file.name for file in (share / PACKAGE / folder).iterdir()} == {file.name for file in files}
    (installed,) = prefix.glob(f"lib/python3*/site-packages/{PACKAGE}")
    published = {file.relative_to(PACKAGE) for file in published_files() if file.parts[0] == PACKAGE}
    found = [file for file in installed.rglob("*") if file.suffix != ".pyc" and file.is_file()]
    assert {file.relative_to(installed) for file in found} == published


def test_a_built_executable_runs_with_the_built_modules(workspace: Path) -> None:
    module = in_built_workspace(
        workspace, f"{sys.executable} -c 'import {PACKAGE} as built; print(built.__file__)'"
    )
    assert module.startswith(str(workspace))
    help_text = in_built_workspace(workspace, f"{workspace}/install/{PACKAGE}/lib/{PACKAGE}/convert --help")
    assert "safetensors" in help_text


def test_activating_the_environment_leaves_no_path_of_another_ros() -> None:
    paths = dict.fromkeys(("PYTHONPATH", "LD_LIBRARY_PATH", "CMAKE_PREFIX_PATH"), "/elsewhere/ros/lib")
    activate = Path(sys.executable).with_name("activate")
    run = subprocess.run(
        ["bash", "-euc", f"source {activate}; env"],
        env=os.environ | paths | {"AMENT_PREFIX_PATH": "/elsewhere/ros"},
        capture_output=True,
        text=True,
        check=True,
    )
    assert "/elsewhere/ros" not in run.stdout
    assert f"AMENT_PREFIX_PATH={sys.prefix}\n" in run.stdout


def test_every_imported_package_is_declared() -> None:
    ros, from_apt = ros_packages(), {MODULE_OF_APT[key] for key in keys_of_apt()}
    needed = imported_packages() - {PACKAGE} - sys.stdlib_module_names
    from_pip = set(pip_requirements())
    assert needed | TYPED_COMMANDS == ros | from_pip
    assert ros & from_pip == set()
    assert from_apt <= from_pip, "on a machine without ROS they come from pip"


def test_the_remedy_for_a_missing_module_names_what_is_declared() -> None:
    assert dict(PIP_PACKAGES) == pip_requirements()


def imported_packages() -> set[str]:
    """What the modules and the launch files import."""
    return {
        name
        for folder in (PACKAGE, "launch")
        for file in (REPOSITORY / folder).rglob("*.py")
        for name in imports(file)
    }


def imports(file: Path) -> Iterator[str]:
    for node in ast.walk(ast.parse(file.read_bytes())):
        if isinstance(node, ast.Import):
            yield from (alias.name.partition(".")[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module is not None and node.level == 0:
            yield node.module.partition(".")[0]


def exec_depends() -> set[str]:
    return {each.text or "" for each in ElementTree.parse(REPOSITORY / "package.xml").iter("exec_depend")}


def keys_of_apt() -> set[str]:
    """The dependencies in package.xml that are no packages of ROS."""
    return {key for key in exec_depends() if key.startswith("python3-")}


def ros_packages() -> set[str]:
    return {MODULE_OF_ROS.get(name, name) for name in exec_depends() - keys_of_apt()}


def pip_requirements() -> dict[str, str]:
    """Import name -> name for pip of what setup.py asks for; with the extras, except ROS from pip."""
    lines = [line for line in distribution(PACKAGE).requires or [] if not line.endswith('extra == "ros"')]
    names = {Requirement(line).name for line in lines}
    return {MODULE_OF_PIP.get(name.lower(), name.replace("-", "_")): name.lower() for name in names}


def from_package_index(installed: Distribution) -> bool:
    """Whether pip put it here; torch itself names the exact versions of the CUDA libraries it brings."""
    name = canonicalize_name(installed.name)
    return (
        installed.read_text("INSTALLER") == "pip\n"
        and not name.startswith(canonicalize_name(PACKAGE))  # its messages, too
        and not name.startswith(("nvidia-", "cuda-", "triton"))
    )


def test_every_installed_package_is_pinned() -> None:
    installed = {
        canonicalize_name(found.name): found.version.partition("+")[0]
        for found in distributions(path=[sysconfig.get_path("purelib")])
        if from_package_index(found)
    }
    assert installed
    assert any(installed.items() <= pins(constraints).items() for constraints in SETS.values())


@pytest.mark.parametrize(
    ("package_set", "newest"), [("tested", (3, 13)), ("apt", (3, 12)), ("kilted", (3, 13))]
)
def test_an_unsuitable_python_is_named_with_the_suitable_ones(
    package_set: str, newest: tuple[int, int]
) -> None:
    python_problem = runpy.run_path(str(REPOSITORY / "requirements" / "check_machine.py"))["python_problem"]
    assert python_problem((3, 10), package_set) == python_problem(newest, package_set) == ""
    for major, minor in ((3, 9), (3, newest[1] + 1)):
        problem = python_problem((major, minor), package_set)
        assert f"Python 3.10 to 3.{newest[1]}" in problem
        assert f"{major}.{minor}" in problem


def pixi_dependencies() -> dict[str, str]:
    """Name and version range of what pixi.toml takes from the conda channels."""
    section = (REPOSITORY / "pixi.toml").read_text().partition("[dependencies]\n")[2].partition("\n[")[0]
    return dict(re.findall(r'^([\w-]+) = "([^"]+)"', section, re.MULTILINE))


def declared_requirements() -> list[Requirement]:
    """What setup.py asks for, with OpenCV and scipy, which conda has for everybody."""
    requirements = [Requirement(line) for line in distribution(PACKAGE).requires or []]
    extras = {"", "opencv", "tracking"}
    return [
        each
        for each in requirements
        if each.marker is None or any(each.marker.evaluate({"extra": extra}) for extra in extras)
    ]


def test_pixi_installs_what_the_manifest_asks_for_and_what_setup_does_in_the_same_versions() -> None:
    packages = {f"ros-jazzy-{key.replace('_', '-')}" for key in exec_depends() - keys_of_apt()}
    assert packages <= pixi_dependencies().keys()
    ranges = {
        OF_CONDA.get(name, name): str(each.specifier) or "*"
        for each in declared_requirements()
        for name in [canonicalize_name(each.name)]
    }
    assert ranges.items() <= pixi_dependencies().items()
