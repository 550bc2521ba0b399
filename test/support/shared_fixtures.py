"""Fixtures of several files of tests, which `conftest.py` names as a plugin."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from support.checkpoint_builder import official_model, saved, stripped
from support.detector_process import PARAMETERS, DetectorProcess, as_arguments, detector_process
from support.preparations import Preparations
from support.recorded_scene import record
from support.served_node import ServedNode


@pytest.fixture
def prepare(ros_domain: int) -> Preparations:
    return Preparations()


@pytest.fixture
def _environment() -> Iterator[None]:
    """As it was, afterwards: a benchmark or demonstration sets that of its own process."""
    before = dict(os.environ)
    yield
    os.environ.clear()
    os.environ.update(before)


@pytest.fixture
def served(prepare: Preparations) -> Iterator[ServedNode]:
    """The node in this process, with models of the test's."""
    with ServedNode(prepare) as served:
        yield served


@pytest.fixture
def active(served: ServedNode) -> ServedNode:
    served.bring_to("active")
    return served


@pytest.fixture(scope="session")
def shared_detector(_isolated: None) -> Iterator[DetectorProcess]:
    """The installed detector; `detector` has it as at the start."""
    with detector_process(*as_arguments(PARAMETERS)) as detector:
        yield detector


@pytest.fixture
def detector(shared_detector: DetectorProcess) -> DetectorProcess:
    """A running process, unconfigured, its parameters as at the start."""
    shared_detector.reset()
    return shared_detector


@pytest.fixture(scope="session")
def checkpoint() -> bytes:
    """A checkpoint like the official ones, with a small model."""
    return saved(stripped(official_model()))


@pytest.fixture(scope="session")
def digest(checkpoint: bytes) -> str:
    return hashlib.sha256(checkpoint).hexdigest()


@pytest.fixture
def drive(tmp_path: Path) -> Path:
    """A recording of the scene."""
    return record(tmp_path / "drive")
