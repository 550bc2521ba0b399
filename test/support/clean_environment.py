"""What an environment holds: one with this package's wheel and what it declares, and the pinned versions."""

from __future__ import annotations

import os
import subprocess
import sys
import sysconfig
from collections.abc import Iterable, Sequence
from importlib.metadata import Distribution, distribution, distributions
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from support.colcon_workspace import PACKAGE, REPOSITORY, clone


def build_wheel(folder: Path) -> Path:
    """The wheel of this package in `folder`, built from a copy of what a clone has."""
    source = clone(folder / "source")
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
    for required in closure(installed[canonicalize_name(PACKAGE)].requires or [], extras):
        if required not in installed:
            _link(distribution(required), site_packages, executables)
    _pip("--python", python, "check")
    return executables


def closure(lines: Iterable[str], extras: Iterable[str] = ()) -> set[str]:
    """The names of all packages that `lines` with these `extras` require, in the running environment."""
    found: set[tuple[str, frozenset[str]]] = set()
    waiting = [(line, frozenset(extras)) for line in lines]
    while waiting:
        line, extras_of_line = waiting.pop()
        wanted = Requirement(line)
        is_wanted = wanted.marker is None or any(
            wanted.marker.evaluate({"extra": extra}) for extra in ("", *extras_of_line)
        )
        key = canonicalize_name(wanted.name), frozenset(wanted.extras)
        if is_wanted and key not in found:
            found.add(key)
            waiting += [(more, key[1]) for more in distribution(wanted.name).requires or []]
    return {name for name, _ in found}


def pins(constraints: str) -> dict[str, str]:
    """Package -> version for this Python; files named by -c included."""
    lines = (REPOSITORY / "requirements" / constraints).read_text().splitlines()
    versions: dict[str, str] = {}
    for line in lines:
        if line.startswith("-c "):
            versions |= pins(line.removeprefix("-c "))
        elif line and not line.startswith("#"):
            requirement = Requirement(line)
            if requirement.marker is None or requirement.marker.evaluate():
                versions[canonicalize_name(requirement.name)] = str(requirement.specifier).removeprefix("==")
    return versions


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
