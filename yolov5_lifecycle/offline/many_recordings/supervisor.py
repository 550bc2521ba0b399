"""Detection in many recordings by workers: nothing is lost when one dies, and nothing is done twice."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager, suppress
from pathlib import Path
from queue import SimpleQueue
from threading import Lock
from typing import Any

from yolov5_lifecycle.atomic_file import OutputError, has_unfinished_outputs
from yolov5_lifecycle.offline.detecting import DetectingError
from yolov5_lifecycle.offline.many_recordings.results import Plan, RecordingResult, Refused, finished_before
from yolov5_lifecycle.offline.many_recordings.summary import (
    BatchProgress,
    BatchTerminal,
    check_summary,
    write_summary,
)
from yolov5_lifecycle.offline.many_recordings.workers import Worker
from yolov5_lifecycle.offline.recordings import SourceRecording, is_recording
from yolov5_lifecycle.offline.terminal import missing_images
from yolov5_lifecycle.printable import is_utf8
from yolov5_lifecycle.unfinished import hold, open_itself, remove_abandoned_folders

MAX_DEATHS = 2
"""Workers that may die at one recording, or one in a row while it loads the model."""
_PROGRESS_S = 0.5
_END_S = 10.0
_PAUSE_S = 0.1


def detect_recordings(
    sources: Sequence[SourceRecording],
    plan: Plan,
    *,
    new_workers: Callable[[int], Sequence[Worker]],
    terminal: BatchTerminal,
) -> BatchProgress:
    """Write a result for each of `sources`, and a summary, to the folder `plan.output`.

    `new_workers` is called with the number of recordings that have no result yet, unless that is 0. Raises
    OutputError, OSError, and DetectingError if the model cannot be loaded or nothing more can be written.
    """
    batch = BatchProgress(len(sources))
    with _output_folder(plan.output):
        for source in sources:
            if (finished := finished_before(source, plan)) is not None:
                batch.add(finished)
        check_summary(plan.output)
        if waiting := [source for source in sources if source.name not in batch.results]:
            _Run(plan, new_workers(len(waiting)), batch, terminal).run(waiting)
        for problem in write_summary(plan, batch, [source.name for source in sources]):
            terminal.remark(problem)
    return batch


@contextmanager
def _output_folder(folder: Path) -> Iterator[None]:
    """Lock `folder` for this process; create it if it is missing, and then remove it if it stays empty."""
    if not is_utf8(str(folder)):
        raise OutputError(
            f"{folder}: the name of the folder of results must be UTF-8: choose another --output."
        )
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
            _remove_unfinished(folder)
            if is_new:
                with suppress(OSError):
                    folder.rmdir()
    finally:
        os.close(descriptor)


def _remove_unfinished(folder: Path) -> None:
    """Remove what killed workers leave behind, once they are dead: Ray does not say when."""
    deadline_s = time.monotonic() + _END_S
    while has_unfinished_outputs(folder) and time.monotonic() < deadline_s:
        remove_abandoned_folders(folder)
        time.sleep(_PAUSE_S)


class _Run:
    """Hands out recordings to workers, each of which a thread waits for."""

    def __init__(
        self, plan: Plan, workers: Sequence[Worker], batch: BatchProgress, terminal: BatchTerminal
    ) -> None:
        self._plan = plan
        self._workers = workers
        self._count = len(workers)
        self._batch = batch
        self._terminal = terminal
        self._free = SimpleQueue[Worker]()
        self._lock = Lock()
        self._is_stopping = False

    def run(self, sources: Sequence[SourceRecording]) -> None:
        executor = ThreadPoolExecutor(len(self._workers))
        try:
            first, *others = self._workers
            running: set[Future[Any]] = {executor.submit(self._start, first)}
            if self._plan.is_open:  # it chooses for all
                running.pop().result()
            running |= {executor.submit(self._start, worker) for worker in others}
            running |= {executor.submit(self._detect, source) for source in sources}
            while running:
                ended, running = wait(running, _PROGRESS_S, FIRST_COMPLETED)
                for future in ended:
                    if (result := future.result()) is not None:  # not that a worker has started
                        self._end(result)
                self._terminal.progress(self._batch)
        finally:
            executor.shutdown(wait=False, cancel_futures=True)
            self._stop()
            executor.shutdown()
            for worker in self._workers:
                worker.close()

    def _end(self, result: RecordingResult) -> None:
        self._batch.add(result)
        if result.state == "failed":
            self._terminal.remark(f"{result.recording}: failed: {result.reason}")
        elif result.missing:
            claimed = result.images + result.missing
            self._terminal.remark(f"{result.recording}: {missing_images(claimed, result.images)}")

    def _start(self, worker: Worker) -> None:
        """Load the model; raises DetectingError if that cannot be loaded, unless others have loaded it."""
        answer = self._load(worker)
        if not isinstance(answer, Refused):
            self._plan = answer
            self._batch.begin()
            self._free.put(worker)
            return
        with self._lock:
            self._count -= 1
        if not self._batch.has_begun or not self._count:
            raise DetectingError(answer.reason)
        worker.stop()
        self._terminal.remark(
            f"continuing with {self._count} worker(s): another one could not start: {answer.reason}"
        )

    def _load(self, worker: Worker, deaths: int = 1) -> Plan | Refused:
        try:
            return worker.load(self._plan)
        except ChildProcessError as error:
            if deaths == MAX_DEATHS:
                raise DetectingError(f"{error} while loading the model, {deaths} times in a row") from None
            self._restart(worker)
            return self._load(worker, deaths + 1)

    def _detect(self, source: SourceRecording, deaths: int = 1) -> RecordingResult:
        worker = self._free.get()
        if self._is_stopping:
            raise ChildProcessError("the worker was stopped")
        try:
            answer = worker.detect(source, lambda images: self._batch.progress(source.name, images))
        except ChildProcessError as error:
            self._restart(worker)
            if deaths < MAX_DEATHS:
                self._terminal.remark(f"{source.name}: {error}; another worker retries it")
            self._start(worker)
            if deaths < MAX_DEATHS:
                return self._detect(source, deaths + 1)
            reason = f"{error} {deaths} times while reading this recording"
            return RecordingResult(
                recording=source.name, path=str(source.path), state="failed", reason=reason
            )
        self._free.put(worker)
        if isinstance(answer, Refused):
            raise DetectingError(answer.reason)
        return answer

    def _restart(self, worker: Worker) -> None:
        with self._lock:
            if self._is_stopping:
                raise ChildProcessError("the worker was stopped")
            worker.restart()

    def _stop(self) -> None:
        with self._lock:
            self._is_stopping = True
            for worker in self._workers:
                worker.stop()
                self._free.put(worker)  # for a thread that waits for one
