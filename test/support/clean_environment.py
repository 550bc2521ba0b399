"""A virtual environment with this package's wheel and what it declares, and nothing else."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import sysconfig
from collections.abc import Iterator, Sequence
from importlib.metadata import Distribution, distribution, distributions
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from support.colcon_workspace import PACKAGE, REPOSITORY, published_files


def build_wheel(folder: Path) -> Path:
    """The wheel of this package in `folder`, built from a copy of what a clone has."""
    source = folder / "source"
    for file in published_files():
        copy = source / file
        copy.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(REPOSITORY / file, copy)
    _pip("wheel", "--no-index", "--no-deps", "--no-build-isolation", "--wheel-dir", folder, source)
    (wheel,) = folder.glob("*.whl")
    return wheel


def build_environment(folder: Path, wheels: Sequence[Path], extras: tuple[str, ...]) -> Path:
    """A new environment in `folder` with `wheels` and the distributions that this package's `extras` require.

    What is in none of the wheels is linked to the running environment, so nothing is downloaded and what is
    not declared is missing. Returns the folder of its executables.
    """
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", folder], check=True)
    executables = folder / "bin"
    python = executables / "python"
    _pip("--python", python, "install", "--no-index", "--no-deps", "--no-compile", *wheels)
    site_packages = Path(sysconfig.get_path("purelib", vars={"base": str(folder)}))
    installed = {canonicalize_name(each.name): each for each in distributions(path=[str(site_packages)])}
    for required in _required(installed[canonicalize_name(PACKAGE)], extras):
        if canonicalize_name(required.name) not in installed:
            _link(required, site_packages, executables)
    _pip("--python", python, "check")
    return executables


def _required(installed: Distribution, extras: tuple[str, ...]) -> list[Distribution]:
    """All distributions that `installed` with its `extras` requires, found in the running environment."""
    found: dict[tuple[str, tuple[str, ...]], Distribution] = {}
    waiting = list(_requirements(installed, extras))
    while waiting:
        requirement = waiting.pop()
        key = canonicalize_name(requirement.name), tuple(sorted(requirement.extras))
        if key not in found:
            found[key] = distribution(requirement.name)
            waiting += _requirements(found[key], key[1])
    return list({canonicalize_name(each.name): each for each in found.values()}.values())


def _requirements(installed: Distribution, extras: tuple[str, ...]) -> Iterator[Requirement]:
    for line in installed.requires or []:
        requirement = Requirement(line)
        marker = requirement.marker
        if marker is None or any(marker.evaluate({"extra": extra}) for extra in ("", *extras)):
            yield requirement


def _link(required: Distribution, site_packages: Path, executables: Path) -> None:
    """Link the files of a distribution, except its executables and compiled modules."""
    for file in required.files or []:
        link = Path(os.path.normpath(site_packages / file))
        if link.parent != executables and file.suffix != ".pyc":
            link.parent.mkdir(parents=True, exist_ok=True)
            link.symlink_to(Path(str(required.locate_file(file))).resolve())


def _pip(*words: str | Path) -> None:
    run = subprocess.run([sys.executable, "-m", "pip", *words], capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stdout + run.stderr
