"""Fixtures that every test may use."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

from yolov5_lifecycle.process.environment import prepare_environment

prepare_environment()  # as the commands do; child processes inherit it

import pytest
from hypothesis import settings
from support.colcon_workspace import REPOSITORY, build_workspace

from yolov5_lifecycle.ros.demo.domain import isolated, own_domain

# A busy machine is no failure of an example.
settings.register_profile("suite", deadline=None)
settings.load_profile("suite")


@pytest.fixture(scope="session")
def reference_dir() -> Path:
    """Folder with weights/yolov5n.pt (official, AGPL-3.0), images/bus.jpg and golden/, its official answers.

    They are not part of this project.
    """
    folder = Path(os.environ.get("YOLOV5_REFERENCE_DIR") or REPOSITORY.parent / "shared")
    if not (folder / "golden" / "yolov5n_bus.json").is_file():
        pytest.skip(f"no reference data in {folder}: set YOLOV5_REFERENCE_DIR to the folder that has it")
    return folder


@pytest.fixture(scope="session", autouse=True)
def _this_machine_only() -> Iterator[None]:
    """Nodes of the tests reach no other machine, and nobody there reaches them."""
    with pytest.MonkeyPatch.context() as environment:
        environment.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        yield


@pytest.fixture(scope="session", autouse=True)
def own_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Tests and their child processes leave the user's cache alone."""
    with pytest.MonkeyPatch.context() as environment:
        environment.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture(scope="session")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A colcon workspace in which the package has been built."""
    folder = tmp_path_factory.mktemp("workspace")
    build_workspace(folder)
    return folder


@pytest.fixture
def ros_domain(monkeypatch: pytest.MonkeyPatch) -> Iterator[int]:
    """A ROS_DOMAIN_ID that nobody else on this machine uses during the test; child processes inherit it."""
    with own_domain() as domain:
        for name, value in isolated({}, domain).items():
            monkeypatch.setenv(name, value)
        yield domain
