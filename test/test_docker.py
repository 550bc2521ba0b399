"""The recipe of the image agrees with the package; docker/try-image tries the image itself."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
import sys
from importlib.metadata import distribution
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from support.clean_environment import pins
from support.colcon_workspace import PACKAGE, REPOSITORY

pytestmark = pytest.mark.long

ENTRYPOINT = REPOSITORY / "docker" / "entrypoint"
BUILT = f"install/{PACKAGE}/lib/{PACKAGE}/detector"
FROM_APT = {"numpy": "python3-numpy", "pyyaml": "python3-yaml"}


def instructions() -> list[tuple[str, str]]:
    """The Dockerfile's instructions and their arguments, lines joined, comments left out."""
    text = re.sub(r"^#.*\n", "", (REPOSITORY / "Dockerfile").read_text(), flags=re.MULTILINE)
    lines = text.replace("\\\n", " ").splitlines()
    return [(line.partition(" ")[0], line.partition(" ")[2].strip()) for line in lines if line]


def arguments_of(name: str) -> list[str]:
    return [argument for instruction, argument in instructions() if instruction == name]


def pip_installs() -> list[list[str]]:
    """The words behind every `pip install`."""
    return [
        shlex.split(command)
        for run in arguments_of("RUN")
        for command in re.findall(r"pip install ([^&|;]*)", run)
    ]


def test_what_setup_asks_for_is_installed_in_the_versions_of_the_apt_constraints() -> None:
    requirements = map(Requirement, distribution(PACKAGE).requires or [])
    needed = {canonicalize_name(each.name) for each in requirements if "extra" not in str(each.marker)}
    installed = {word for words in pip_installs() for word in words}
    assert all("-c requirements/constraints-apt.txt" in " ".join(words) for words in pip_installs())
    names = {word for word in installed if re.fullmatch(r"[a-z][a-z0-9-]*", word)}
    assert names <= pins("constraints-apt.txt").keys()
    brought_by_pydantic = {"annotated-types", "pydantic-core"}
    assert needed - brought_by_pydantic - FROM_APT.keys() <= installed
    assert {*FROM_APT.values(), "python3-opencv", "python3-scipy"} <= set(arguments_of("RUN")[-2].split())


@pytest.mark.parametrize(
    ("torch", "uses_cpu_builds", "code"),
    [
        pytest.param("", [False], 0, id="usual"),
        pytest.param("cpu", [True, False], 0, id="CPU"),
        pytest.param("gpu", [], 1, id="unknown"),
    ],
)
def test_torch_is_taken_from_where_the_makefile_takes_it(
    torch: str, uses_cpu_builds: list[bool], code: int
) -> None:
    (run,) = (argument for argument in arguments_of("RUN") if "pip install" in argument)
    script = run.replace("/opt/venv/bin/pip", "echo").replace("python3 -m venv", "true")
    tried = subprocess.run(
        ["sh", "-c", script], env=os.environ | {"TORCH": torch}, capture_output=True, text=True, check=False
    )
    assert tried.returncode == code, tried.stderr
    index = re.search(r"^TORCH_INDEX := (\S+)$", (REPOSITORY / "Makefile").read_text(), re.MULTILINE)
    assert index is not None
    installs = tried.stdout.splitlines()
    assert [f"--index-url {index[1]} " in install for install in installs] == uses_cpu_builds


@pytest.mark.parametrize(
    ("colcon", "code"),
    [
        pytest.param("true", 1, id="no package found"),
        pytest.param(f"install -D /dev/null {BUILT}", 1, id="without colcon-bash"),
        pytest.param("install -D /dev/null install/setup.bash", 1, id="without colcon-ros"),
        pytest.param(f"install -D /dev/null {BUILT} && touch install/setup.bash", 0, id="package built"),
    ],
)
def test_a_build_that_lacks_what_the_entry_point_runs_fails(colcon: str, code: int, tmp_path: Path) -> None:
    (run,) = (argument for argument in arguments_of("RUN") if "colcon build" in argument)
    script = run.replace("/opt/venv/bin/python /usr/bin/colcon build", colcon)
    script = script.replace("/opt/ros/jazzy/setup.sh", "/dev/null")
    tried = subprocess.run(["sh", "-c", script], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert tried.returncode == code
    assert ("colcon made no install/" in tried.stderr) == bool(code)


def test_setup_does_without_the_files_that_the_image_leaves_out(tmp_path: Path) -> None:
    for name in ("setup.py", "setup.cfg", "package.xml", "pyproject.toml"):
        shutil.copy(REPOSITORY / name, tmp_path)
    command = [sys.executable, "setup.py", "--name", "--description", "--long-description"]
    run = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (run.returncode, run.stdout.splitlines()[:1]) == (0, [PACKAGE]), run.stderr


def entered(workspace: Path, *words: str) -> subprocess.CompletedProcess[str]:
    environment = {"PATH": os.environ["PATH"], "WORKSPACE": str(workspace), "AMENT_PREFIX_PATH": sys.prefix}
    return subprocess.run([ENTRYPOINT, *words], env=environment, capture_output=True, text=True)


def test_the_entry_point_runs_executables_by_name_and_anything_else(workspace: Path) -> None:
    assert "c d.pt: expected a name that ends" in entered(workspace, "convert", "a.pt", "c d.pt").stderr
    assert entered(workspace, "echo", "two  blanks").stdout == "two  blanks\n"
    prefix = entered(workspace, "printenv", "AMENT_PREFIX_PATH").stdout
    assert prefix.startswith(str(workspace / "install" / PACKAGE))
    nothing = entered(workspace)
    assert nothing.returncode != 0
    assert "an executable, such as detector" in nothing.stderr
