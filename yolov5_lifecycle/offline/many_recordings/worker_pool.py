"""Workers as processes of this machine, watched by the process that started them."""

from __future__ import annotations

import itertools
import json
import os
import selectors
import socket
import subprocess
import sys
import time
from contextlib import suppress
from dataclasses import dataclass, field

from yolov5_lifecycle.offline.many_recordings.answers import MAX_BYTES, AnswerError, read_answer
from yolov5_lifecycle.offline.many_recordings.plan import Plan
from yolov5_lifecycle.offline.many_recordings.workers import Died, Ended, Event, Progress, Ready, Refused
from yolov5_lifecycle.offline.recordings import SourceRecording
from yolov5_lifecycle.process.environment import compute_threads
from yolov5_lifecycle.process.memory import available_bytes

# The path of this process; `-m` would search the current folder first, which may be one of recordings.
_PROGRAM = "import sys; sys.path[:] = {path!r}; from {module} import main; main({descriptor})"
_MODULE = "yolov5_lifecycle.offline.many_recordings.worker_process"
_THREADS = ("OMP_NUM_THREADS", "OPENCV_FOR_THREADS_NUM")
"""Variables for the number of threads of torch, which the runtimes follow, and of OpenCV."""
_WORKER_BYTES = 1 << 30
_READ_BYTES = 1 << 16
_WHILE_LOADING = frozenset({"ready", "refused"})
_WHILE_RUNNING = frozenset({"progress", "ended", "refused"})
_END_S = 10.0


def suitable_count(recordings: int) -> int:
    """How many workers this machine has room for: one per core, but at most one per GiB of free memory."""
    free_bytes = available_bytes()
    room = compute_threads() if free_bytes is None else min(compute_threads(), free_bytes // _WORKER_BYTES)
    return max(1, min(room, recordings))


@dataclass
class _Worker:
    process: subprocess.Popen[bytes]
    connection: socket.socket
    received: bytearray = field(default_factory=bytearray)
    expected: frozenset[str] = frozenset()
    """The answers that it may give now."""
    recording: str | None = None
    """Name of the recording that it was given last."""

    def send(self, text: str) -> None:
        with suppress(OSError):  # it has died, which is reported when its connection is read
            self.connection.sendall(text.encode() + b"\n")

    def lines(self, block: bytes) -> list[bytes]:
        """The lines that are whole with `block`; raises AnswerError if one is too long."""
        self.received += block
        if b"\n" not in block:
            if len(self.received) > MAX_BYTES:
                raise AnswerError(f"the worker answered more than {MAX_BYTES} bytes")
            return []
        *lines, rest = bytes(self.received).split(b"\n")
        self.received = bytearray(rest)
        return lines

    def ended(self, patience_s: float) -> int:
        """Wait for its end, kill it after `patience_s`, and return its exit code."""
        self.connection.close()
        try:
            return self.process.wait(patience_s)
        except subprocess.TimeoutExpired:
            self.process.kill()
            return self.process.wait()


class ProcessWorkers:
    """Up to `max_count` processes that share the cores of this machine. See `Workers`.

    Each runs `main` of `module`.
    """

    def __init__(self, max_count: int, *, module: str = _MODULE) -> None:
        self.max_count = max_count
        self._module = module
        self.threads = max(1, compute_threads() // max_count)
        self._workers: dict[int, _Worker] = {}
        self._spares: list[_Worker] = []
        self._numbers = itertools.count()
        self._selector = selectors.DefaultSelector()

    @property
    def process_ids(self) -> dict[int, int]:
        """Process id of each worker."""
        return {number: worker.process.pid for number, worker in self._workers.items()}

    def start(self, plan: Plan) -> int:
        """Start a worker; the first call starts the processes of all, which then import their libraries."""
        number = next(self._numbers)
        if number == 0:
            self._spares = [self._new_process() for _ in range(self.max_count)]
        worker = self._workers[number] = self._spares.pop() if self._spares else self._new_process()
        self._selector.register(worker.connection, selectors.EVENT_READ, number)
        worker.expected = _WHILE_LOADING
        worker.send(plan.model_dump_json())
        return number

    def begin(self, worker: int, source: SourceRecording) -> None:
        running = self._workers[worker]
        running.expected, running.recording = _WHILE_RUNNING, source.name
        running.send(json.dumps({"name": source.name, "path": str(source.path)}))

    def events(self, timeout_s: float) -> list[Event]:
        return [
            event for key, _ in self._selector.select(timeout_s) for event in self._events_of(int(key.data))
        ]

    def close(self) -> None:
        workers = [*self._workers.values(), *self._spares]
        for worker in workers:
            worker.process.terminate()
        deadline_s = time.monotonic() + _END_S
        for worker in workers:
            worker.ended(max(0.0, deadline_s - time.monotonic()))
        self._workers.clear()
        self._spares.clear()
        self._selector.close()

    def _events_of(self, number: int) -> list[Event]:
        worker = self._workers[number]
        try:
            block = worker.connection.recv(_READ_BYTES)
        except ConnectionResetError:
            block = b""
        if not block:
            return [Died(number, _reason(self._forget(number)))]
        try:
            events = [_event(number, worker, line) for line in worker.lines(block)]
        except AnswerError as error:
            worker.process.kill()
            self._forget(number)
            return [Died(number, str(error))]
        if any(isinstance(event, Refused) for event in events):
            self._forget(number)
        return events

    def _forget(self, number: int) -> int:
        """Wait for the end of a worker and return its exit code."""
        worker = self._workers.pop(number)
        self._selector.unregister(worker.connection)
        return worker.ended(_END_S)

    def _new_process(self) -> _Worker:
        own, other = socket.socketpair()
        program = _PROGRAM.format(path=sys.path, module=self._module, descriptor=other.fileno())
        with other:
            process = subprocess.Popen(
                [sys.executable, "-c", program],
                pass_fds=[other.fileno()],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                env=dict.fromkeys(_THREADS, str(self.threads)) | os.environ,
                start_new_session=True,  # Ctrl-C in a terminal is for the process that started them
            )
        return _Worker(process, own)


def _event(number: int, worker: _Worker, line: bytes) -> Event:
    """What `worker` answered; raises AnswerError if it was not asked that."""
    answer = read_answer(line, expected=worker.expected, recording=worker.recording)
    if answer.progress is not None:
        return Progress(number, answer.progress)
    worker.expected = frozenset()  # until it is given the next recording
    if answer.ready is not None:
        return Ready(number, *answer.ready)
    if answer.ended is not None:
        return Ended(number, answer.ended)
    return Refused(number, answer.refused or "")


def _reason(code: int) -> str:
    if code < 0:
        return f"the worker died (signal {-code})"
    return f"the worker exited (code {code})"
