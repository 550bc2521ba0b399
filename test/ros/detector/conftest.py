"""The node in this process with models of the test's, and the installed detector as a process."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from support.detector_process import PARAMETERS, DetectorProcess, as_arguments, detector_process
from support.served_node import Preparations, ServedNode


@pytest.fixture
def prepare(ros_domain: int) -> Preparations:
    return Preparations()


@pytest.fixture
def served(prepare: Preparations) -> Iterator[ServedNode]:
    with ServedNode(prepare) as served:
        yield served
    assert served.escaped == []


@pytest.fixture(scope="session")
def shared_detector(_isolated: None) -> Iterator[DetectorProcess]:
    with detector_process(*as_arguments(PARAMETERS)) as detector:
        yield detector


@pytest.fixture
def detector(shared_detector: DetectorProcess) -> DetectorProcess:
    """A running process, unconfigured, its parameters as at the start."""
    shared_detector.reset()
    return shared_detector


@pytest.fixture
def active(detector: DetectorProcess) -> DetectorProcess:
    detector.bring_to("active")
    return detector
