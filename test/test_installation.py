"""What `make` installs, and what it refuses before anything is downloaded."""

from __future__ import annotations

import os
import re
import runpy
import shlex
import shutil
import signal
import subprocess
import sys
import threading
import zipfile
from collections.abc import Iterator
from importlib.metadata import packages_distributions
from pathlib import Path
from typing import Any

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from support.clean_environment import closure
from support.colcon_workspace import PACKAGE, REPOSITORY
from support.file_server import FileServer, ServedRequest
from support.started import printed_by, started

pytestmark = pytest.mark.long

CHECK = runpy.run_path(str(REPOSITORY / "requirements" / "check_machine.py"))
TORCH = runpy.run_path(str(REPOSITORY / "requirements" / "install_torch.py"))
CONSTRAINTS = REPOSITORY / "requirements" / "constraints.txt"
WHEEL = "torch-2.13.0+cpu-py3-none-any.whl"
NO_INDEX = "http://127.0.0.1:9"
"""Nobody listens on the port that is reserved for discarding."""

PATIENCE_S = 60.0


def lines_of(requirements: str) -> list[str]:
    lines = (REPOSITORY / "requirements" / requirements).read_text().splitlines()
    included = [more for line in lines if line.startswith("-r ") for more in lines_of(line[3:])]
    return [*included, *(line for line in lines if re.match(r"\w", line))]


@pytest.fixture
def clone(tmp_path: Path) -> Path:
    """What `make` needs until it has made the environment."""
    folder = tmp_path / "clone"
    shutil.copytree(REPOSITORY / "requirements", folder / "requirements")
    shutil.copytree(REPOSITORY / "interfaces", folder / "interfaces")
    for file in ("Makefile", "setup.py", "setup.cfg", "package.xml"):
        shutil.copy2(REPOSITORY / file, folder)
    return folder


def make(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        ["make", f"PYTHON={sys.executable}", *words],
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
    )


def test_a_path_in_which_the_messages_can_be_built_is_taken() -> None:
    for path in ("/home/user/yolov5_lifecycle", "/srv/a-b.c_d/e+f@g=h/~j k"):
        assert CHECK["path_problem"](path) == ""


@pytest.mark.parametrize(
    ("path", "named"),
    [
        pytest.param("/home/user/a,b", "','", id="comma"),
        pytest.param("/home/\u0131\u015f\u0131k/robot", r"'\u0131\u015f'", id="Turkish"),
        pytest.param("/home/o'hara", '"\'"', id="apostrophe"),
        pytest.param("/tmp/a\nb", r"'\n'", id="newline"),
    ],
)
def test_a_path_in_which_the_messages_cannot_be_built_is_refused_with_the_remedy(
    path: str, named: str
) -> None:
    problem = CHECK["path_problem"](path)
    assert problem.startswith(f"Move this folder to a path without {named}, such as ~/yolov5_lifecycle")
    assert problem.isascii()
    assert problem.isprintable()


@pytest.mark.parametrize(
    ("writable", "free_bytes", "remedy"),
    [
        pytest.param(True, 2 * 10**9, "", id="room"),
        pytest.param(True, 2 * 10**9 - 1, "Free 2 GB of disk space", id="full disk"),
        pytest.param(False, 10**12, "Clone the repository into a folder of your own", id="read-only"),
    ],
)
def test_a_folder_that_cannot_hold_the_environment_is_refused(
    writable: bool, free_bytes: int, remedy: str
) -> None:
    problem = CHECK["folder_problem"]("/srv/clone", writable, free_bytes)
    assert problem.startswith(remedy)
    assert bool(problem) == bool(remedy)


def test_make_refuses_a_path_before_it_installs_anything(clone: Path) -> None:
    elsewhere = clone.rename(clone.with_name("été"))
    refused = make(elsewhere, "demo")
    assert refused.returncode != 0
    assert "Move this folder to a path without" in refused.stderr
    assert not (elsewhere / ".venv").exists()


@pytest.mark.parametrize(
    ("words", "told"),
    [
        pytest.param(
            ["PYTHON=no-such-python"], "does not run; name a Python 3.10 to 3.13", id="no such program"
        ),
        pytest.param(["PYTHON=false"], "does not run; name a Python 3.10 to 3.13", id="a name of pyenv's"),
        pytest.param(["TORCH=gpu"], "TORCH=gpu: expected 'cpu'", id="an unknown build of torch"),
        pytest.param(["SET=humble"], "expected 'tested' (", id="an unknown set"),
        *(
            pytest.param([f"VENV={folder}"], "expected a folder here whose name begins with .venv-", id=name)
            for folder, name in (
                ("..", "parent"),
                (".venv-3.12/bin", "below"),
                (".venv-a .venv-b", "two"),
            )
        ),
    ],
)
def test_make_refuses_what_it_cannot_use_and_says_what_it_expects(
    words: list[str], told: str, clone: Path
) -> None:
    refused = make(clone, *words, "demo")
    assert refused.returncode != 0
    assert told in refused.stderr
    assert [path.name for path in clone.iterdir() if path.name.startswith(".venv")] == []


def test_the_matrix_has_an_environment_for_each() -> None:
    shown = make(
        REPOSITORY, "-n", "test-matrix", "MATRIX=3.11-tested 3.12-tested 3.12-apt 3.12-kilted"
    ).stdout
    folders = {line.split("/")[0] for line in shown.splitlines() if "/bin/python -m pytest" in line}
    assert len(folders) == shown.count(": passed") > 0, shown


def test_the_nodes_and_the_demo_need_nothing_that_the_tests_add() -> None:
    built = {PACKAGE, *(folder.name for folder in (REPOSITORY / "interfaces").iterdir())}
    added = {canonicalize_name(Requirement(line).name) for line in lines_of("tests.txt")}
    needed = closure(lines_of("environment.txt"))
    assert added.isdisjoint(needed)
    installed = needed | {canonicalize_name(name) for name in built}
    absent = [
        module
        for module, packages in packages_distributions().items()
        if installed.isdisjoint(canonicalize_name(package) for package in packages)
    ]
    assert {"onnxruntime", "openvino", "pytest"} <= set(absent)
    program = f"""
import importlib, pkgutil, sys
sys.modules.update(dict.fromkeys({absent!r}))
import {PACKAGE}.ros as ros
for found in pkgutil.walk_packages(ros.__path__, ros.__name__ + "."):
    importlib.import_module(found.name)
"""
    assert printed_by(program) == ""


@pytest.fixture
def installed(clone: Path) -> Path:
    """A clone in which `make install` has run with no TORCH given."""
    (clone / ".venv").mkdir()
    version = f"{sys.version_info[0]}.{sys.version_info[1]}"
    for stamp in (f".dependencies-{version}", ".interfaces", ".package", ".tests"):
        (clone / ".venv" / stamp).touch()
    return clone


@pytest.mark.parametrize(
    ("words", "anew"),
    [
        pytest.param([], False, id="none asked for"),
        pytest.param(["TORCH=cuda"], True, id="another"),
        pytest.param(["TORCH=cpu"], False, id="the one that is there"),
    ],
)
def test_another_build_of_torch_makes_the_environment_anew(
    words: list[str], anew: bool, installed: Path
) -> None:
    (installed / ".venv" / ".torch-cpu").touch()
    shown = make(installed, "-n", "demo", *words)
    assert shown.returncode == 0, shown.stderr
    assert ("rm -rf .venv\n" in shown.stdout) == anew
    assert ("-r requirements/environment.txt" in shown.stdout) == anew


def test_a_path_with_a_space_is_one_word_of_every_command(clone: Path) -> None:
    folder = clone.rename(clone.with_name("my robot"))
    shown = make(folder, "-n", "demo", "test")
    assert shown.returncode == 0, shown.stderr
    words = shlex.split(shown.stdout)
    assert any(word.startswith(f"{folder}/") or f"={folder}/" in word for word in words)
    assert [word for word in words if word.endswith("/my")] == []


def test_what_another_environment_has_set_changes_nothing(
    installed: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("PYTHONHOME", "PYTHONPATH", "CONDA_PREFIX", "PIP_USER", "VIRTUAL_ENV"):
        monkeypatch.setenv(name, "/elsewhere")
    shown = make(installed, "-n", "demo")
    assert (shown.returncode, shown.stderr) == (0, "")
    assert "pip install" not in shown.stdout


def test_where_the_demo_cannot_write_make_says_where_it_can_run(installed: Path) -> None:
    (installed / "build").write_text("a file where a folder should be")
    refused = make(installed, "demo")
    assert refused.returncode != 0
    assert f'Run "{installed}/.venv/bin/demo" in a folder of your own' in refused.stderr


@pytest.fixture
def plain_pip(monkeypatch: pytest.MonkeyPatch) -> None:
    """pip without the settings of this machine, which may bring a build of torch."""
    for name in [name for name in os.environ if name.startswith("PIP_")]:
        monkeypatch.delenv(name)
    monkeypatch.setenv("PIP_CONFIG_FILE", os.devnull)


@pytest.fixture
def index(tmp_path: Path) -> Iterator[FileServer]:
    """An index with a CPU build of torch, which holds nothing."""
    wheel = tmp_path / WHEEL
    folder = "torch-2.13.0+cpu.dist-info"
    with zipfile.ZipFile(wheel, "w") as archive:
        archive.writestr(f"{folder}/METADATA", "Metadata-Version: 2.1\nName: torch\nVersion: 2.13.0+cpu\n")
        archive.writestr(f"{folder}/WHEEL", "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n")
        archive.writestr(f"{folder}/RECORD", "")

    def serve(request: ServedRequest) -> None:
        if request.path == "/torch/":
            request.answer(f'<a href="/{WHEEL}">{WHEEL}</a>'.encode(), Content_Type="text/html")
        else:
            request.answer(wheel.read_bytes())

    with FileServer(serve) as server:
        yield server


def install(wanted: str, index: str, folder: Path, driver: str = "") -> int:
    """Exit status of what `make` runs, with an installation into `folder`."""
    words = ["-c", str(CONSTRAINTS), "--retries", "0", "--target", str(folder)]
    status: int = TORCH["main"](wanted, index, words, driver)
    return status


@pytest.mark.usefixtures("plain_pip")
@pytest.mark.parametrize("wanted", [pytest.param("", id="nothing asked for"), pytest.param("cpu", id="cpu")])
def test_without_a_driver_torch_comes_from_the_index_of_cpu_builds(
    wanted: str, index: FileServer, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    assert install(wanted, index.address, tmp_path / "installed") == 0
    assert (tmp_path / "installed" / "torch-2.13.0+cpu.dist-info").is_dir()
    assert ("no NVIDIA driver was found" in capfd.readouterr().out) == (wanted == "")


@pytest.mark.parametrize(
    ("wanted", "driver"),
    [
        pytest.param("", "/proc/driver/nvidia/version", id="driver"),
        pytest.param("cuda", "", id="cuda"),
    ],
)
def test_with_a_driver_or_when_asked_for_torch_is_left_to_pip(
    wanted: str, driver: str, index: FileServer, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    assert install(wanted, index.address, tmp_path / "installed", driver) == 0
    assert index.requests == []
    assert (driver in capfd.readouterr().out) or wanted == "cuda"


@pytest.mark.usefixtures("plain_pip")
def test_of_an_index_that_cannot_be_reached_only_the_build_that_was_asked_for_is_a_must(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    assert install("cpu", NO_INDEX, tmp_path / "installed") != 0
    assert install("", NO_INDEX, tmp_path / "installed") == 0
    assert f"{NO_INDEX} has not given torch, see above: pip's usual build follows" in capfd.readouterr().out
    assert not (tmp_path / "installed").exists()


@pytest.mark.usefixtures("plain_pip")
@pytest.mark.skipif(bool(TORCH["nvidia_driver"]()), reason="this machine has a driver of NVIDIA's")
def test_an_interrupt_is_no_reason_for_another_build(tmp_path: Path) -> None:
    asked = threading.Event()

    def serve(request: ServedRequest) -> None:
        asked.set()
        request.server.closing.wait()

    with FileServer(serve) as server:
        program = [sys.executable, str(REPOSITORY / "requirements" / "install_torch.py"), "", server.address]
        words = ["-c", str(CONSTRAINTS), "--target", str(tmp_path / "installed")]
        with started(
            [*program, *words],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            start_new_session=True,
        ) as installation:
            assert asked.wait(PATIENCE_S)
            os.killpg(installation.pid, signal.SIGINT)
            told, _ = installation.communicate(timeout=PATIENCE_S)
    assert installation.returncode == -signal.SIGINT
    assert "usual build" not in told
    assert "Traceback" not in told


def test_a_driver_is_found_by_what_it_leaves(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    nvidia_driver: Any = TORCH["nvidia_driver"]
    monkeypatch.setenv("PATH", str(tmp_path))
    left = tmp_path / "version"
    assert nvidia_driver([str(left)]) == ""
    left.touch()
    assert nvidia_driver([str(left)]) == str(left)
    command = tmp_path / "nvidia-smi"
    command.touch(mode=0o755)
    assert nvidia_driver([]) == str(command)
