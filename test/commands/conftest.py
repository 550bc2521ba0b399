"""What `fetch_weights` is tried with."""

from __future__ import annotations

import hashlib
from pathlib import Path

import pytest
from support.checkpoint_builder import official_model, saved, stripped


@pytest.fixture(scope="session")
def checkpoint() -> bytes:
    return saved(stripped(official_model()))


@pytest.fixture(scope="session")
def digest(checkpoint: bytes) -> str:
    return hashlib.sha256(checkpoint).hexdigest()


@pytest.fixture(autouse=True)
def _without_proxy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("no_proxy", "*")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder that is not there yet."""
    return tmp_path / "ros" / "yolov5"
