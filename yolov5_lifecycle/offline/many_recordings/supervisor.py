"""Detection in many recordings by workers: nothing is lost when one dies, and nothing is done twice."""

from __future__ import annotations

import os
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path
from queue import Empty, SimpleQueue

from yolov5_lifecycle.atomic_file import OutputError, hold, open_itself, remove_abandoned_folders
from yolov5_lifecycle.offline.detecting import DetectingError
from yolov5_lifecycle.offline.many_recordings.results import (
    Batch,
    Plan,
    RecordingResult,
    check_summary,
    finished_before,
    write_summary,
)
from yolov5_lifecycle.offline.many_recordings.workers import Worker
from yolov5_lifecycle.offline.recordings import SourceRecording, is_recording
from yolov5_lifecycle.offline.terminal import Terminal, missing_images

MAX_DEATHS = 2
"""Workers that may die at one recording."""
_PROGRESS_S = 0.5


def detect_recordings(
    sources: Sequence[SourceRecording],
    plan: Plan,
    *,
    new_workers: Callable[[int], Sequence[Worker]],
    terminal: Terminal,
) -> Batch:
    """Write a result for each of `sources`, and a summary, to the folder `plan.output`.

    `new_workers` is called with the number of recordings that have no result yet, unless that is 0. Raises
    OutputError, OSError, and DetectingError if the model cannot be loaded or nothing more can be written.
    """
    batch = Batch(len(sources))
    with _output_folder(plan.output):
        for source in sources:
            if (finished := finished_before(source, plan)) is not None:
                batch.add(finished)
        check_summary(plan.output)
        if waiting := [source for source in sources if source.name not in batch.results]:
            _Run(plan, new_workers(len(waiting)), batch, terminal).run(waiting)
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


class _Run:
    """Hands out recordings to workers, each of which has a thread that waits for its answers."""

    def __init__(self, plan: Plan, workers: Sequence[Worker], batch: Batch, terminal: Terminal) -> None:
        self._plan = plan
        self._workers = workers
        self._batch = batch
        self._terminal = terminal
        self._waiting = SimpleQueue[SourceRecording | None]()
        self._ended = SimpleQueue[RecordingResult | Exception]()
        self._deaths = Counter[str]()

    def run(self, sources: Sequence[SourceRecording]) -> None:
        """Add the results of `sources` to the batch; the first worker chooses the runtime for all."""
        for source in sources:
            self._waiting.put(source)
        executor = ThreadPoolExecutor(len(self._workers))
        try:
            self._plan = _loaded(self._workers[0], self._plan)
            self._batch.begun_s = time.monotonic()
            for worker in self._workers:
                executor.submit(self._serve, worker, is_loaded=worker is self._workers[0])
            self._collect()
        finally:
            for worker in self._workers:
                worker.stop()
                self._waiting.put(None)
            executor.shutdown()
            for worker in self._workers:
                worker.close()

    def _collect(self) -> None:
        """Add what the threads end until all is there; raises what they raise."""
        while len(self._batch.results) < self._batch.count:
            with suppress(Empty):
                ended = self._ended.get(timeout=_PROGRESS_S)
                if isinstance(ended, Exception):
                    raise ended
                self._batch.add(ended)
                if ended.state == "failed":
                    self._terminal.tell(f"{ended.recording}: failed: {ended.reason}")
                elif ended.missing:
                    missing = missing_images(ended.images + ended.missing, ended.images)
                    self._terminal.tell(f"{ended.recording}: {missing}")
            self._terminal.show(
                f"{len(self._batch.results)} of {self._batch.count} recordings, {self._batch.images} images, "
                f"{self._batch.rate_hz:.1f} per second"
            )

    def _serve(self, worker: Worker, *, is_loaded: bool) -> None:
        """Let `worker` detect in one recording after the other, until there are none."""
        try:
            while True:
                if not is_loaded:
                    self._load_another(worker)
                if (source := self._waiting.get()) is None:
                    return
                is_loaded = self._detect(worker, source)
        except Exception as error:  # noqa: BLE001 - whatever it is, it ends the run
            self._ended.put(error)

    def _load_another(self, worker: Worker) -> None:
        try:
            _loaded(worker, self._plan)
        except DetectingError as error:
            raise DetectingError(
                f"another worker could not start: {error}. If memory is short, give a smaller --jobs."
            ) from None

    def _detect(self, worker: Worker, source: SourceRecording) -> bool:
        """Whether `worker` still lives; if it died, another one begins `source` again, or it has failed."""
        try:
            self._ended.put(worker.detect(source, lambda images: self._batch.progress(source.name, images)))
        except ChildProcessError as error:
            worker.start()
            self._deaths[source.name] += 1
            if self._deaths[source.name] < MAX_DEATHS:
                self._terminal.tell(f"{source.name}: {error}; another worker retries it")
                self._waiting.put(source)
            else:
                reason = f"{error} {MAX_DEATHS} times while reading this recording"
                self._ended.put(
                    RecordingResult(
                        recording=source.name, path=str(source.path), state="failed", reason=reason
                    )
                )
            return False
        return True


def _loaded(worker: Worker, plan: Plan) -> Plan:
    """The plan as `worker` has chosen it; raises DetectingError if it cannot load the model."""
    try:
        return worker.load(plan)
    except ChildProcessError as error:
        raise DetectingError(f"{error} while loading the model") from None
