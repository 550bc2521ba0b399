"""No callback in the executor waits without a limit: every call that may block has one, or a reason."""

from __future__ import annotations

import ast
from collections.abc import Iterator

from support.colcon_workspace import REPOSITORY

PACKAGE = REPOSITORY / "yolov5_lifecycle"
FOLDERS = ("ros", "ros/detector", "ros/parameters", "streaming")
"""What the executor of the detector runs."""
BLOCKING = {"wait": 1, "join": 1, "result": 1, "acquire": 1, "wait_for": 2, "get": 1, "put": 2}
"""Methods that wait for another thread, and how many arguments they have when the last one is the limit."""
NO_LIMIT = "a SimpleQueue takes any number of objects"
DONE = "the future is done: an awaited callback has it"
ALLOWED = {
    "streaming.inference_threads._run": "the inference thread itself waits for work",
    "streaming.inference_threads._begin_tasks": NO_LIMIT,
    "streaming.inference_threads.close": NO_LIMIT,
    "ros.child_process.__exit__": "of `demo` and its like, after SIGKILL",
    "ros.observer.call": DONE,
    "ros.detector.session.model": f"{DONE}, unless a program activates the node without its executor",
    "ros.detector.session.apply": DONE,
    "ros.detector.managed_resources.prepared": DONE,
    "ros.detector.reconfiguration._reload_now": DONE,
    "ros.detector.reconfiguration._commit": DONE,
}


def has_limit(call: ast.Call, method: str) -> bool:
    given = [*call.args, *(keyword.value for keyword in call.keywords)]
    is_endless = any(isinstance(value, ast.Constant) and value.value is None for value in given)
    return len(given) >= BLOCKING[method] and not is_endless


def endless_waits(source: str) -> Iterator[str]:
    """Names of the functions with a call that may wait for ever."""
    for function in ast.walk(ast.parse(source)):
        if not isinstance(function, (ast.FunctionDef, ast.AsyncFunctionDef)):
            continue
        for node in ast.walk(function):
            if not (isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute)):
                continue
            if (method := node.func.attr) in BLOCKING and not has_limit(node, method):
                yield function.name


def test_every_wait_has_a_limit_or_a_reason() -> None:
    found = {
        f"{folder.replace('/', '.')}.{path.stem}.{function}"
        for folder in FOLDERS
        for path in (PACKAGE / folder).glob("*.py")
        for function in endless_waits(path.read_text())
    }
    assert found == set(ALLOWED)


def test_a_wait_without_limit_is_found() -> None:
    endless = ("job.wait()", "job.wait(timeout=None)", "changed.wait_for(is_over)", "future.result()")
    limited = ("job.wait(timeout_s)", "changed.wait_for(is_over, 3.0)", "', '.join(names)")
    calls = "\n".join(f"    {call}" for call in (*endless, *limited))
    assert list(endless_waits(f"def callback():\n{calls}\n")) == ["callback"] * len(endless)
