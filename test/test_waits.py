"""No callback in the executor waits without a limit: every call that may block has one."""

from __future__ import annotations

import ast
from collections.abc import Iterator

from support.colcon_workspace import REPOSITORY

FOLDERS = ("ros/detector", "ros/parameters", "streaming")
"""What the executor of the detector runs."""
BLOCKING = {"wait": 1, "join": 1, "acquire": 1, "wait_for": 2}
"""Methods that wait for another thread, and how many arguments they have when the last one is the limit."""


def has_limit(call: ast.Call, method: str) -> bool:
    given = [*call.args, *(keyword.value for keyword in call.keywords)]
    is_endless = any(isinstance(value, ast.Constant) and value.value is None for value in given)
    return len(given) >= BLOCKING[method] and not is_endless


def endless_waits(source: str) -> Iterator[str]:
    """Calls that may wait for ever."""
    for call in (node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.Call)):
        method = getattr(call.func, "attr", "")
        if method in BLOCKING and not has_limit(call, method):
            yield ast.unparse(call)


def test_every_wait_has_a_limit() -> None:
    files = [file for folder in FOLDERS for file in (REPOSITORY / "yolov5_lifecycle" / folder).glob("*.py")]
    assert len(files) > len(FOLDERS)
    assert [f"{file.name}: {call}" for file in files for call in endless_waits(file.read_text())] == []
