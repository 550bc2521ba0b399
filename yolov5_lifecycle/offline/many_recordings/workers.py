"""Worker processes of this machine, each with one model, for one recording at a time."""

from __future__ import annotations

import os
import subprocess
import sys
from multiprocessing.connection import Pipe
from threading import Lock
from typing import Any

from yolov5_lifecycle.offline.many_recordings.recording_task import OnImage, main
from yolov5_lifecycle.offline.many_recordings.results import Plan, RecordingResult
from yolov5_lifecycle.offline.recordings import SourceRecording
from yolov5_lifecycle.process.environment import compute_threads, prepare_environment
from yolov5_lifecycle.process.memory import available_bytes

# The path of this process; `-m` would search the current folder first, which may be one of recordings.
# `main` needs torch, for which the environment must be prepared.
_PROGRAM = (
    "import sys; sys.path[:] = {path!r}; "
    f"from {prepare_environment.__module__} import prepare_environment; prepare_environment(); "
    f"from {main.__module__} import main; main({{descriptor}})"
)
_THREADS = ("OMP_NUM_THREADS", "OPENCV_FOR_THREADS_NUM")
"""Variables for the number of threads of torch, which the runtimes follow, and of OpenCV."""
_WORKER_BYTES = 1 << 30
_END_S = 10.0


def suitable_count(recordings: int, jobs: int | None = None) -> int:
    """`jobs` or as many workers as this machine has room for, but no more than `recordings`.

    There is room for one per core, but at most one per GiB of free memory.
    """
    free_bytes = available_bytes()
    room = compute_threads() if free_bytes is None else min(compute_threads(), free_bytes // _WORKER_BYTES)
    return max(1, min(jobs or room, recordings))


class Worker:
    """A process of this machine, which has `count` of them; begins without a model."""

    def __init__(self, count: int) -> None:
        self._threads = max(1, compute_threads() // count)
        self._lock = Lock()
        self._is_stopped = False
        self.start()

    def start(self) -> None:
        """Begin, also again after it has died; raises ChildProcessError after `stop`."""
        with self._lock:
            if self._is_stopped:
                raise ChildProcessError("the worker was stopped")
            self._connection, other = Pipe()
            program = _PROGRAM.format(path=sys.path, descriptor=other.fileno())
            with other:
                self.process = subprocess.Popen(
                    [sys.executable, "-c", program],
                    pass_fds=[other.fileno()],
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.DEVNULL,
                    env=dict.fromkeys(_THREADS, str(self._threads)) | os.environ,
                    start_new_session=True,  # Ctrl-C in a terminal is for the process that started them
                )

    def load(self, plan: Plan) -> Plan:
        """Load the model; returns the plan with what was chosen.

        Raises DetectingError if it cannot be loaded, and ChildProcessError if the worker dies.
        """
        chosen: Plan = self._answer(plan, lambda _: None)
        return chosen

    def detect(self, source: SourceRecording, on_image: OnImage) -> RecordingResult:
        """Write the result of a recording; raises DetectingError for lack of room, and ChildProcessError."""
        result: RecordingResult = self._answer(source, on_image)
        return result

    def stop(self) -> None:
        """Make it end, and another thread that waits for its answer raise ChildProcessError."""
        with self._lock:
            self._is_stopped = True
            self.process.terminate()

    def close(self) -> None:
        """Wait until it has ended."""
        self._connection.close()
        try:
            self.process.wait(_END_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()

    def _answer(self, argument: object, on_image: OnImage) -> Any:
        """What the process answers to `argument`; raises an error that it answers, and ChildProcessError."""
        try:
            self._connection.send(argument)
            while isinstance(answer := self._connection.recv(), int):
                on_image(answer)
        except (EOFError, OSError):
            self.close()
            code = self.process.returncode
            end = f"died (signal {-code})" if code < 0 else f"exited (code {code})"
            raise ChildProcessError(f"the worker {end}") from None
        if isinstance(answer, Exception):
            raise answer
        return answer
