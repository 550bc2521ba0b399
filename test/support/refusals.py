"""A command that cannot do what it is asked to: it says why, prints nothing and leaves the folder alone."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest


class Refused:
    """Runs a command whose exit code is not 0 in the current folder, and returns what it told."""

    def __init__(self, capsys: pytest.CaptureFixture[str]) -> None:
        self._capsys = capsys

    def __call__(self, command: Callable[[list[str]], int], *words: object, code: int = 1) -> str:
        before = _contents()
        try:
            ended: object = command([str(word) for word in words])
        except SystemExit as end:
            ended = end.code
        output, error = self._capsys.readouterr()
        assert (ended, output) == (code, ""), error
        assert "Traceback" not in error
        assert _contents() == before
        return error

    def in_a_line(self, command: Callable[[list[str]], int], *words: object, code: int = 1) -> str:
        (line,) = self(command, *words, code=code).splitlines()
        return line


def _contents() -> dict[Path, int]:
    """When each file here was written; 0 for a folder, in which something may have been for a while."""
    paths = sorted(Path().rglob("*"))
    return {path: 0 if path.is_dir() else path.lstat().st_mtime_ns for path in paths}


@pytest.fixture
def refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Refused:
    """The current folder is that of the test."""
    monkeypatch.chdir(tmp_path)
    return Refused(capsys)
