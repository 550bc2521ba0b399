"""Pixi installs what the manifest and setup.py ask for."""

from __future__ import annotations

import re
from importlib.metadata import distribution
from xml.etree import ElementTree

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from support.colcon_workspace import PACKAGE, REPOSITORY

pytestmark = pytest.mark.long

MANIFEST = ElementTree.parse(REPOSITORY / "package.xml")
OF_CONDA = {"torch": "pytorch", "opencv-python-headless": "py-opencv"}


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


def test_pixi_installs_every_dependency_of_the_manifest() -> None:
    keys = {each.text or "" for each in MANIFEST.iter("exec_depend")}
    packages = {f"ros-jazzy-{key.replace('_', '-')}" for key in keys if not key.startswith("python3-")}
    assert packages <= pixi_dependencies().keys()


def test_pixi_installs_what_setup_asks_for_in_the_same_versions() -> None:
    ranges = {
        OF_CONDA.get(name, name): str(each.specifier) or "*"
        for each in declared_requirements()
        for name in [canonicalize_name(each.name)]
    }
    assert ranges.items() <= pixi_dependencies().items()
