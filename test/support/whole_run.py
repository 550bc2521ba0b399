"""The run of all tests as a whole: it says what was running when it was ended, and leaves nothing behind."""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import signal
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from types import FrameType

import pytest

_RUN = "YOLOV5_TEST_RUN"
"""Environment variable of all processes of a run: its folder."""
_END_S = 10.0
_SHARED_MEMORY = Path("/dev/shm")
_OF_FAST_DDS = ("fastrtps_*", "sem.fastrtps_*", "fast_datasharing_*")


class WholeRun:
    """Plugin for the process that distributes the tests to workers, or runs them all itself."""

    def __init__(self, max_failures: int) -> None:
        """`max_failures` end the run, none if 0."""
        self._max_failures = max_failures
        self._folder = os.environ[_RUN] = tempfile.mkdtemp(prefix="test-run-")
        self._began_s = time.time()
        self._running: dict[str, float] = {}

    def pytest_sessionstart(self) -> None:
        """Let SIGTERM, by which `timeout` ends a run, do what Ctrl-C does: pytest reports what it has."""
        signal.signal(signal.SIGTERM, _interrupt)

    def pytest_runtest_logstart(self, nodeid: str) -> None:
        self._running[nodeid] = time.monotonic()

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        self._max_failures -= report.failed
        if report.failed and self._max_failures == 0:
            _stop_file().touch()

    def pytest_runtest_logfinish(self, nodeid: str) -> None:
        self._running.pop(nodeid, None)

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        for nodeid, begin_s in self._running.items():
            terminalreporter.line(f"UNFINISHED after {time.monotonic() - begin_s:.0f} s: {nodeid}")

    @pytest.hookimpl(trylast=True)
    def pytest_unconfigure(self) -> None:
        """End what tests and crashed workers have started, and free the memory that it shared."""
        end_processes(self._folder)
        remove_unused_memory(self._began_s)
        shutil.rmtree(self._folder)


class Worker:
    """Plugin for a worker: after the last failure that a run may have, it ends with the test in progress.

    xdist itself goes on with the files that a worker has already, whose tests may all wait for the same.
    """

    def pytest_sessionstart(self, session: pytest.Session) -> None:
        self._session = session

    def pytest_runtest_logfinish(self) -> None:
        if _stop_file().exists():
            self._session.shouldfail = "too many failures in this run"


def _stop_file() -> Path:
    return Path(os.environ[_RUN]) / "stop"


def _interrupt(number: int, _: FrameType | None) -> None:
    raise KeyboardInterrupt(signal.Signals(number).name)


def end_processes(folder: str) -> None:
    """Send SIGTERM to every process of a run, and SIGKILL to those that have not ended after a while."""
    for number in (signal.SIGTERM, signal.SIGKILL):
        for process_id in processes_of(folder):
            with contextlib.suppress(ProcessLookupError):
                os.kill(process_id, number)
        deadline_s = time.monotonic() + _END_S
        while list(processes_of(folder)) and time.monotonic() < deadline_s:
            time.sleep(0.05)


def processes_of(folder: str) -> Iterator[int]:
    """Identifiers of the living processes that began with the environment of a run."""
    mark = f"{_RUN}={folder}".encode()
    for process in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            if mark in (process / "environ").read_bytes().split(b"\0"):
                yield int(process.name)


def remove_unused_memory(began_s: float) -> None:
    """Remove the shared memory of Fast DDS made since `began_s` (time.time()), mapped by no living process.

    A process that is killed leaves its own, if no other one is there to notice:
    https://github.com/eProsima/Fast-DDS/issues/2377.
    """
    files = [path for pattern in _OF_FAST_DDS for path in _SHARED_MEMORY.glob(pattern)]
    used = mapped_files()
    for path in files:
        with contextlib.suppress(OSError):
            if segment_of(path) not in used and path.stat().st_ctime >= began_s:
                path.unlink()


def segment_of(path: Path) -> str:
    """The segment or port that a lock or a semaphore belongs to."""
    return re.sub(r"_(el|sl|mutex)$", "", str(path).replace("/sem.", "/"))


def mapped_files() -> set[str]:
    """Paths of the shared memory that any process has mapped, as far as this user may know."""
    found = set()
    for maps in Path("/proc").glob("[0-9]*/maps"):
        with contextlib.suppress(OSError):
            found.update(re.findall(r"(/dev/shm/\S+)", maps.read_text()))
    return found
