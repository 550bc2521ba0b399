"""A recording to detect in."""

from __future__ import annotations

from pathlib import Path

import pytest
from rosbags.rosbag2 import StoragePlugin
from support.recorded_scene import COUNT, raw, record


@pytest.fixture
def drive(tmp_path: Path) -> Path:
    """A recording of the scene."""
    return record(tmp_path / "drive", [raw(number) for number in range(COUNT)], storage=StoragePlugin.MCAP)
