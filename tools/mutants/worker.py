"""Runs tests again and again, each time in a fork of a process that has imported the large libraries.

`python -m tools.mutants.worker`, in a copy of the repository: for each line of JSON on standard input one on
standard output. `tests`, `measured` (file of the copy) and `limit_s` come in; `code`, `lines` and `taken_s`
go out.
"""

from __future__ import annotations

import gc
import json
import os
import select
import signal
import sys
import threading
import time
import traceback
import warnings
from collections.abc import Mapping
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import coverage
import pytest

LIBRARIES = (
    "torch",
    "cv2",
    "numpy",
    "scipy.optimize",
    "pydantic",
    "yaml",
    "safetensors.torch",
    "rclpy",
    "selenium.webdriver.chrome.webdriver",
)
LOG = Path("build") / "mutants.log"
LINES = Path("build") / "mutants-lines.json"
KILLED_BY_TIME = -1
OPTIONS = (
    "-x",
    "-q",
    "--no-header",
    "-m",
    "not long",
    "-p",
    "no:cacheprovider",
    "-p",
    "no:anyio",
    "-p",
    "no:threadexception",
    "--basetemp=build/mutants-tests",
)


class WithoutShrinking:
    """A failing example is enough; the smallest one takes time."""

    @pytest.hookimpl(trylast=True)
    def pytest_configure(self) -> None:
        import hypothesis  # not before pytest rewrites its assertions

        phases = [phase for phase in hypothesis.Phase if phase.name not in ("shrink", "explain")]
        hypothesis.settings.register_profile("mutants", parent=hypothesis.settings.default, phases=phases)
        hypothesis.settings.load_profile("mutants")


def main() -> None:
    """Answer until standard input is closed."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for library in LIBRARIES:
            import_module(library)
    gc.freeze()  # a garbage collection of a fork neither visits nor copies what the libraries hold
    for line in sys.stdin:
        answer = run(**json.loads(line))
        sys.stdout.write(json.dumps(answer) + "\n")
        sys.stdout.flush()


def run(tests: list[str], measured: str, limit_s: float) -> Mapping[str, Any]:
    """Exit code of pytest, KILLED_BY_TIME after `limit_s`; executed lines of each file below `measured`."""
    LINES.unlink(missing_ok=True)
    begun_s = time.monotonic()
    process_id = os.fork()
    if not process_id:
        _run_in_child(tests, measured)
    code = _code_of(process_id, limit_s)
    lines = json.loads(LINES.read_text()) if LINES.exists() else {}
    return {"code": code, "lines": lines, "taken_s": time.monotonic() - begun_s}


def _code_of(process_id: int, limit_s: float) -> int:
    """End the process and all that it started."""
    ended = os.pidfd_open(process_id)
    try:
        in_time = bool(select.select([ended], [], [], limit_s)[0])
    finally:
        os.close(ended)
    if not in_time:
        os.killpg(process_id, signal.SIGKILL)
    _, status = os.waitpid(process_id, 0)
    if in_time:
        _end_group(process_id)
    return os.waitstatus_to_exitcode(status) if in_time else KILLED_BY_TIME


def _end_group(group: int) -> None:
    """End what a test has left running."""
    try:
        os.killpg(group, signal.SIGKILL)
    except ProcessLookupError:
        return


def _run_in_child(tests: list[str], measured: str) -> None:
    code = 3
    try:
        os.setpgid(0, 0)
        _redirect_output()
        threading.excepthook = _end
        found = find_spec("yolov5_lifecycle")
        assert found is not None, "no package"
        assert str(found.origin).startswith(str(Path.cwd())), f"{found.origin} is not in the copy"
        code = (
            _measured(tests, measured) if measured else pytest.main([*OPTIONS, *tests], [WithoutShrinking()])
        )
    except BaseException:  # noqa: BLE001 - a fork must not go on as its parent
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


def _end(_: threading.ExceptHookArgs) -> None:
    """End the trial with an error that no thread handles: the test may wait long for that thread."""
    os._exit(pytest.ExitCode.TESTS_FAILED)


def _measured(tests: list[str], measured: str) -> int:
    recorder = coverage.Coverage(data_file=None, include=[f"{Path.cwd()}/{measured}/*"], config_file=False)
    recorder.start()
    code = pytest.main([*OPTIONS, *tests], [WithoutShrinking()])
    recorder.stop()
    data = recorder.get_data()
    LINES.write_text(json.dumps({file: data.lines(file) for file in data.measured_files()}))
    return code


def _redirect_output() -> None:
    LOG.parent.mkdir(exist_ok=True)
    log = os.open(LOG, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    for stream in (1, 2):
        os.dup2(log, stream)
    os.close(log)


if __name__ == "__main__":
    main()
