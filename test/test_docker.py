"""The image's recipe agrees with the package; docker/try-build builds the image."""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from fnmatch import fnmatch
from importlib.metadata import distribution
from pathlib import Path
from typing import Any

import pytest
import yaml
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from support.clean_environment import pins
from support.colcon_workspace import COMMANDS, PACKAGE, REPOSITORY
from support.pages import typed

from yolov5_lifecycle.ros.camera.settings import CameraSettings
from yolov5_lifecycle.settings.settings import SETTINGS, Settings

pytestmark = pytest.mark.long

ENTRYPOINT = REPOSITORY / "docker" / "entrypoint"
BUILT = f"install/{PACKAGE}/lib/{PACKAGE}/detector"
SHARE = f"/workspace/install/{PACKAGE}/share/{PACKAGE}/"
FROM_APT = {"numpy": "python3-numpy", "pyyaml": "python3-yaml"}


def instructions() -> list[tuple[str, str]]:
    """The Dockerfile's instructions and their arguments, lines joined, comments left out."""
    text = re.sub(r"^#.*\n", "", (REPOSITORY / "Dockerfile").read_text(), flags=re.MULTILINE)
    lines = text.replace("\\\n", " ").splitlines()
    return [(line.partition(" ")[0], line.partition(" ")[2].strip()) for line in lines if line]


def arguments_of(name: str) -> list[str]:
    return [argument for instruction, argument in instructions() if instruction == name]


def variables() -> dict[str, str]:
    """What ENV sets."""
    return dict(entry.split("=") for entry in arguments_of("ENV"))


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


def test_the_image_runs_without_root_and_keeps_weights_where_the_node_looks() -> None:
    (user,) = arguments_of("USER")
    (volume,) = arguments_of("VOLUME")
    assert int(user) > 0
    home = Path(variables()["HOME"])
    assert Settings().weights_dir.replace("~", str(home)) == volume
    assert any(volume in run and f"-o {home.name}" in run for run in arguments_of("RUN"))


def test_what_is_installed_in_the_image_is_not_ignored() -> None:
    ignored = (REPOSITORY / ".dockerignore").read_text().split("\n")
    needed = ["setup.py", "setup.cfg", "package.xml", "resource", PACKAGE, "config", "launch", "weights"]
    assert [(name, one) for name in needed for one in ignored if fnmatch(name, one)] == []


def test_setup_does_without_the_files_that_the_image_leaves_out(tmp_path: Path) -> None:
    for name in ("setup.py", "setup.cfg", "package.xml", "pyproject.toml"):
        shutil.copy(REPOSITORY / name, tmp_path)
    command = [sys.executable, "setup.py", "--name", "--description", "--long-description"]
    run = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (run.returncode, run.stdout.splitlines()[:1]) == (0, [PACKAGE]), run.stderr


def check_command(words: list[str]) -> None:
    """`words` behind the entry point name an executable, parameters and files that exist."""
    assert words[0] in COMMANDS
    allowed = {
        "detector": {setting.name for setting in SETTINGS},
        "camera": set(CameraSettings.model_fields),
        "console": set[str](),
    }[words[0]]
    assert set(re.findall(r"-p (\w+):=", " ".join(words))) <= allowed
    files = [word.removeprefix(SHARE) for word in words if word.startswith("/workspace")]
    assert [file for file in files if not (REPOSITORY / file).is_file()] == []


def test_the_image_starts_the_detector() -> None:
    (command,) = arguments_of("CMD")
    check_command(json.loads(command))
    assert arguments_of("ENTRYPOINT") == ['["/entrypoint"]']


def test_the_services_of_compose_share_memory_and_the_weights_of_the_image() -> None:
    services: dict[str, Any] = yaml.safe_load((REPOSITORY / "compose.yaml").read_text())["services"]
    for name in ("camera", "detector", "console"):
        check_command(services[name]["command"].split())
        assert (services[name]["network_mode"], services[name]["ipc"]) == ("host", "host")
        profile = services[name]["environment"]["FASTRTPS_DEFAULT_PROFILES_FILE"]
        assert (REPOSITORY / profile.removeprefix(SHARE)).is_file()
    (mount,) = services["detector"]["volumes"]
    assert mount.split(":")[1] in arguments_of("VOLUME")


def test_a_node_that_is_not_active_is_not_healthy_and_has_time_to_answer() -> None:
    (check,) = arguments_of("HEALTHCHECK")
    command = json.loads(check.partition(" CMD ")[2])
    assert command[:3] == ["/entrypoint", "bash", "-c"]
    pattern = shlex.split(command[3].partition("| grep -q ")[2])[0]
    states = ["unconfigured [1]", "inactive [2]", "active [3]", "Node not found"]
    assert [state for state in states if re.search(pattern, state)] == ["active [3]"]
    assert variables()["YOLOV5_NODE"] == "/yolov5"
    (discovery_s, limit_s) = re.findall(r"--(?:spin-time |timeout=)(\d+)", check)[::-1]
    assert 5 <= int(discovery_s) <= int(limit_s) / 3, "ros2 itself waits half a second"


def test_what_builds_with_podman_keeps_the_health_check() -> None:
    lines = [
        *typed(REPOSITORY / "docs" / "docker.md"),
        *(ENTRYPOINT.parent / "try-build").read_text().splitlines(),
    ]
    builds = [line for line in lines if re.search(r"\b(podman|buildah) (build|bud)\b", line)]
    assert len(builds) == 2
    assert [line for line in builds if "--format docker" not in line] == []


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
