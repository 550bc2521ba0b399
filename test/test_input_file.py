"""`package://` is found as ROS finds it, and for this package also where ROS is not sourced."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import yolov5_lifecycle
from yolov5_lifecycle.input_file import resolve_package

PACKAGE = "yolov5_lifecycle"
URL = f"package://{PACKAGE}/weights/shapes.safetensors"
MODULES = ("__init__.py", "input_file.py")


def install(prefix: Path, modules: Path, package: str = PACKAGE) -> None:
    """Put the modules that resolve `package://` below `prefix`, with the share folder that pip makes."""
    (prefix / modules / PACKAGE).mkdir(parents=True)
    for name in MODULES:
        shutil.copy(Path(yolov5_lifecycle.__file__).with_name(name), prefix / modules / PACKAGE / name)
    marker = prefix / "share" / "ament_index" / "resource_index" / "packages" / package
    marker.parent.mkdir(parents=True)
    marker.touch()


def resolved(url: str, modules: Path, **environment: str) -> str:
    """What the modules in the folder `modules` make of `url`, or the last line that they tell."""
    program = f"from {PACKAGE}.input_file import resolve_package; print(resolve_package({url!r}))"
    run = subprocess.run(
        [sys.executable, "-c", program],
        cwd=modules,
        env={"PATH": os.defpath} | environment,
        capture_output=True,
        text=True,
        check=False,
    )
    return (run.stdout or run.stderr).splitlines()[-1]


@pytest.mark.parametrize(
    "modules",
    [
        pytest.param("lib/python3.12/site-packages", id="environment"),
        pytest.param(".", id="target"),
    ],
)
def test_the_package_finds_its_own_files_where_pip_installed_it(tmp_path: Path, modules: str) -> None:
    install(tmp_path, Path(modules))
    expected = str(tmp_path / "share" / PACKAGE / "weights" / "shapes.safetensors")
    assert resolved(URL, tmp_path / modules) == expected


def test_the_sourced_workspace_comes_first(tmp_path: Path) -> None:
    for name in ("sourced", "installed"):
        install(tmp_path / name, Path("lib"))
    found = resolved(URL, tmp_path / "installed" / "lib", AMENT_PREFIX_PATH=f"/no:{tmp_path / 'sourced'}")
    assert found == str(tmp_path / "sourced" / "share" / PACKAGE / "weights" / "shapes.safetensors")


def test_another_package_is_found_only_where_it_is_sourced(tmp_path: Path) -> None:
    install(tmp_path, Path("lib"), package="my_robot")
    told = resolved("package://my_robot/a.pt", tmp_path / "lib")
    assert "no package 'my_robot' is installed in this environment. Source the workspace" in told
    found = resolved("package://my_robot/a.pt", tmp_path / "lib", AMENT_PREFIX_PATH=str(tmp_path))
    assert found == str(tmp_path / "share" / "my_robot" / "a.pt")


def test_an_editable_installation_finds_its_own_files(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("AMENT_PREFIX_PATH", raising=False)
    assert Path(resolve_package(URL)).is_file()
