"""Detection in many recordings by workers: nothing is lost when one dies, and nothing is done twice."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from multiprocessing.connection import Pipe, wait
from pathlib import Path

from yolov5_lifecycle.atomic_file import OutputError, hold, open_itself, remove_abandoned_folders
from yolov5_lifecycle.offline.detecting import DetectingError
from yolov5_lifecycle.offline.many_recordings.recording_task import main
from yolov5_lifecycle.offline.many_recordings.results import (
    Batch,
    Plan,
    RecordingResult,
    check_summary,
    failed,
    finished_before,
    write_summary,
)
from yolov5_lifecycle.offline.recordings import SourceRecording, is_recording
from yolov5_lifecycle.offline.terminal import Terminal, missing_images
from yolov5_lifecycle.process.environment import compute_threads, prepare_environment
from yolov5_lifecycle.process.memory import available_bytes

MAX_DEATHS = 2
"""Workers that may die at one recording."""
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
_PROGRESS_S = 0.5


def suitable_count(recordings: int, jobs: int | None = None) -> int:
    """`jobs` or as many workers as this machine has room for, but no more than `recordings`.

    There is room for one per core, but at most one per GiB of free memory.
    """
    free_bytes = available_bytes()
    room = compute_threads() if free_bytes is None else min(compute_threads(), free_bytes // _WORKER_BYTES)
    return max(1, min(jobs or room, recordings))


class Worker:
    """One of `count` processes of this machine, each with one model, for one recording at a time."""

    def __init__(self, count: int) -> None:
        self.source: SourceRecording | None = None
        """What it detects in; None while it loads the model."""
        self.connection, other = Pipe()
        threads = str(max(1, compute_threads() // count))
        with other:
            self._process = subprocess.Popen(
                [sys.executable, "-c", _PROGRAM.format(path=sys.path, descriptor=other.fileno())],
                pass_fds=[other.fileno()],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                env=dict.fromkeys(_THREADS, threads) | os.environ,
                start_new_session=True,  # Ctrl-C in a terminal is for the process that started them
            )

    def send(self, task: Plan | SourceRecording) -> None:
        """Let it load the model of a plan, or detect in a recording."""
        with suppress(OSError):  # it has died, as `answer` will tell
            self.connection.send(task)

    def answer(self) -> Plan | int | RecordingResult:
        """What it says: the plan as it has chosen it; how many images are done, and then the result.

        Raises DetectingError if it cannot load the model or nothing more can be written, and
        ChildProcessError if it has died at a recording.
        """
        try:
            answer = self.connection.recv()
        except (EOFError, OSError):
            code = self.close()
            end = f"the worker died (signal {-code})" if code < 0 else f"the worker exited (code {code})"
            if self.source is None:
                raise DetectingError(f"{end} while loading the model") from None
            raise ChildProcessError(end) from None
        if isinstance(answer, DetectingError):
            raise answer
        assert isinstance(answer, Plan | int | RecordingResult)
        return answer

    def stop(self) -> None:
        """Make it end."""
        self._process.terminate()

    def close(self) -> int:
        """Wait until it has ended; returns its exit code."""
        self.connection.close()
        try:
            return self._process.wait(_END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            return self._process.wait()


def detect_recordings(
    sources: Sequence[SourceRecording],
    plan: Plan,
    *,
    jobs: int | None,
    terminal: Terminal,
    new_worker: Callable[[int], Worker] = Worker,
) -> Batch:
    """Write a result for each of `sources`, and a summary, to the folder `plan.output`.

    Raises OutputError, OSError, and DetectingError if the model cannot be loaded or nothing more can be
    written.
    """
    batch = Batch(len(sources))
    with _output_folder(plan.output):
        for source in sources:
            if (finished := finished_before(source, plan)) is not None:
                batch.add(finished)
        check_summary(plan.output)
        if waiting := deque(source for source in sources if source.name not in batch.results):
            _Run(waiting, plan, new_worker, suitable_count(len(waiting), jobs), batch, terminal).run()
        write_summary(plan, batch, [source.name for source in sources])
    return batch


@contextmanager
def _output_folder(folder: Path) -> Iterator[None]:
    """Lock `folder` for this process; create it if it is missing, and then remove it if it stays empty."""
    if not folder.parent.is_dir():
        raise OutputError(f"{folder.parent}: folder not found; create it first.")
    if folder.exists() and not folder.is_dir():
        raise OutputError(f"{folder} is not a folder: many recordings need one for their results.")
    if folder.exists() and is_recording(folder):
        raise OutputError(f"{folder} is a recording: choose another folder for the results.")
    is_new = not folder.exists()
    folder.mkdir(exist_ok=True)
    descriptor = open_itself(os.path.realpath(folder))
    try:
        if not hold(descriptor, Path(os.path.realpath(folder))):
            raise OutputError(f"{folder}: another detect_bag is writing to it; wait until it has finished.")
        remove_abandoned_folders(folder)
        try:
            yield
        finally:
            remove_abandoned_folders(folder)  # of killed workers
            if is_new:
                with suppress(OSError):
                    folder.rmdir()
    finally:
        os.close(descriptor)


@dataclass
class _Run:
    """Hands out recordings to at most `count` workers at a time; the first chooses the runtime for all."""

    waiting: deque[SourceRecording]
    plan: Plan
    new_worker: Callable[[int], Worker]
    count: int
    batch: Batch
    terminal: Terminal
    workers: list[Worker] = field(default_factory=list)
    """Those that load the model or detect."""
    is_chosen: bool = False
    """Whether the first worker has loaded the model."""
    deaths: Counter[str] = field(default_factory=Counter)
    """By recording."""

    def run(self) -> None:
        """Add the results of all recordings to the batch."""
        try:
            for _ in range(self.count):  # while the first loads the model, the others start
                self.workers.append(self.new_worker(self.count))
            self.workers[0].send(self.plan)
            while len(self.batch.results) < self.batch.count:  # without waiting for a model not needed
                ready = wait([worker.connection for worker in self.workers], _PROGRESS_S)
                for worker in [worker for worker in self.workers if worker.connection in ready]:
                    self._hear(worker)
                self.terminal.show(self.batch.progress)
        finally:
            for worker in self.workers:
                worker.stop()
            for worker in self.workers:
                worker.close()

    def _hear(self, worker: Worker) -> None:
        """Take what `worker` says, and give it another recording unless it is busy with one."""
        try:
            answer = worker.answer()
        except ChildProcessError as error:
            self._bury(worker, error)
            return
        except DetectingError as error:
            is_first = worker is self.workers[0] and not self.is_chosen
            if worker.source is not None or is_first:
                raise
            raise DetectingError(
                f"another worker could not start: {error}. If memory is short, give a smaller --jobs."
            ) from None
        if isinstance(answer, int):
            assert worker.source is not None
            self.batch.in_progress[worker.source.name] = answer
            return
        if isinstance(answer, RecordingResult):
            self._end(answer)
        elif not self.is_chosen:
            self._choose(answer)
        self._give(worker)

    def _choose(self, plan: Plan) -> None:
        """Let the other workers load the same model as the first."""
        self.plan, self.is_chosen = plan, True
        self.batch.begun_s = time.monotonic()
        for worker in self.workers[1:]:
            worker.send(plan)

    def _give(self, worker: Worker) -> None:
        """Let `worker` begin the next recording, or end."""
        if self.waiting:
            worker.source = self.waiting.popleft()
            worker.send(worker.source)
        else:
            self.workers.remove(worker)
            worker.stop()
            worker.close()

    def _bury(self, worker: Worker, error: ChildProcessError) -> None:
        """Let another worker begin the recording of one that has died, or tell that it has failed."""
        self.workers.remove(worker)
        source = worker.source
        assert source is not None
        self.deaths[source.name] += 1
        if self.deaths[source.name] < MAX_DEATHS:
            self.terminal.tell(f"{source.name}: {error}; another worker retries it")
            self.waiting.append(source)
        else:
            reason = f"{error} {MAX_DEATHS} times while reading this recording"
            self._end(finished_before(source, self.plan) or failed(source, reason))
        if self.waiting:
            self.workers.append(self.new_worker(self.count))
            self.workers[-1].send(self.plan)

    def _end(self, result: RecordingResult) -> None:
        self.batch.add(result)
        if result.state == "failed":
            self.terminal.tell(f"{result.recording}: failed: {result.reason}")
        elif result.missing:
            missing = missing_images(result.images + result.missing, result.images)
            self.terminal.tell(f"{result.recording}: {missing}")
