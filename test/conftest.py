"""Fixtures that every test may use."""

from __future__ import annotations

import fcntl
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).parents[1]


@pytest.fixture(scope="session")
def reference_dir() -> Path:
    """Folder with weights/yolov5n.pt (official, AGPL-3.0), images/bus.jpg and golden/, its official answers.

    They are not part of this project.
    """
    folder = Path(os.environ.get("YOLOV5_REFERENCE_DIR") or REPOSITORY.parent / "shared")
    if not (folder / "golden" / "yolov5n_bus.json").is_file():
        pytest.skip(f"no reference data in {folder}: set YOLOV5_REFERENCE_DIR to the folder that has it")
    return folder


@pytest.fixture
def ros_domain(monkeypatch: pytest.MonkeyPatch) -> Iterator[int]:
    """A ROS_DOMAIN_ID that nobody else on this machine uses during the test; child processes inherit it."""
    folder = Path(tempfile.gettempdir()) / "yolov5_lifecycle_domains"
    folder.mkdir(exist_ok=True)
    for domain in range(1, 101):
        with (folder / str(domain)).open("w") as lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                continue
            monkeypatch.setenv("ROS_DOMAIN_ID", str(domain))
            monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
            yield domain
            return
    pytest.fail("all 100 test domains are in use")
