"""Worker processes of this machine, each with one model, for one recording at a time.

Importing this module imports neither numpy nor torch, for which a worker first prepares its environment.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from multiprocessing.connection import Connection, Pipe
from threading import Lock
from typing import TYPE_CHECKING, Any, NoReturn

from yolov5_lifecycle.process.environment import compute_threads, prepare_environment
from yolov5_lifecycle.process.memory import available_bytes
from yolov5_lifecycle.process.standard_streams import complain

if TYPE_CHECKING:
    from yolov5_lifecycle.offline.many_recordings.recording_task import OnImage
    from yolov5_lifecycle.offline.many_recordings.results import Plan, RecordingResult
    from yolov5_lifecycle.offline.recordings import SourceRecording

# The path of this process; `-m` would search the current folder first, which may be one of recordings.
_PROGRAM = "import sys; sys.path[:] = {path!r}; from {module} import main; main({descriptor})"
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
            program = _PROGRAM.format(path=sys.path, module=__name__, descriptor=other.fileno())
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


def main(descriptor: int) -> NoReturn:
    """Work for the other end of the socket with this `descriptor`, until that is closed."""
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, lambda number, _: sys.exit(128 + number))
    os.set_inheritable(descriptor, False)
    try:
        _serve(Connection(descriptor))
    except (EOFError, ConnectionError):
        pass  # nobody waits for the results any more
    except Exception as error:  # noqa: BLE001 - whatever it is, the process ends
        complain("detect_bag", f"a worker ends: {type(error).__name__}: {error}")
    finally:
        os._exit(1)  # freeing a model takes longer than ending


def _serve(connection: Connection[Any, Any]) -> None:
    """Answer a plan with what was chosen for it, and then each recording with its result."""
    prepare_environment()
    # Imported here: they import torch, for which the environment must be prepared.
    from yolov5_lifecycle.offline.detecting import DetectingError
    from yolov5_lifecycle.offline.many_recordings.recording_task import RecordingTask
    from yolov5_lifecycle.printable import in_lines
    from yolov5_lifecycle.runtimes.runtime import InferenceError

    plan = connection.recv()
    try:
        task = RecordingTask(plan, connection.send)
    except (ValueError, OSError, ImportError, InferenceError) as error:
        connection.send(DetectingError(in_lines(str(error) or type(error).__name__)))
        return
    connection.send(task.plan)
    while True:
        connection.send(task.run(connection.recv()))
