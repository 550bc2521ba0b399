"""Detection in many recordings by workers: nothing is lost when one dies, and nothing is done twice."""

from __future__ import annotations

import os
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import Protocol

from yolov5_lifecycle.atomic_file import OutputError, remove_unfinished_outputs
from yolov5_lifecycle.offline.detecting import DetectingError
from yolov5_lifecycle.offline.many_recordings.finished import finished_before
from yolov5_lifecycle.offline.many_recordings.plan import Plan
from yolov5_lifecycle.offline.many_recordings.recording_result import RecordingResult
from yolov5_lifecycle.offline.many_recordings.summary import check_summary, write_summary
from yolov5_lifecycle.offline.many_recordings.workers import (
    Died,
    Ended,
    Event,
    Progress,
    Ready,
    Refused,
    Workers,
)
from yolov5_lifecycle.offline.recordings import SourceRecording, is_recording
from yolov5_lifecycle.offline.terminal import missing_images
from yolov5_lifecycle.printable import in_lines, is_utf8
from yolov5_lifecycle.unfinished import hold, open_itself

MAX_DEATHS = 2
"""Workers that may die at one recording, or in a row while they load the model."""
_EVENT_S = 1.0


class Tally:
    """How far a run over `count` recordings is."""

    def __init__(self, count: int) -> None:
        self.count = count
        self.results: dict[str, RecordingResult] = {}
        self.images_in_progress: dict[int, int] = {}
        self._images = 0
        self._begun_s: float | None = None

    def begin(self) -> None:
        """The first model is loaded."""
        self._begun_s = time.monotonic() if self._begun_s is None else self._begun_s

    def add(self, result: RecordingResult) -> None:
        self.results[result.recording] = result
        self._images += result.images if result.state == "done" else 0

    @property
    def images(self) -> int:
        """Images of this run, of unfinished recordings too."""
        return self._images + sum(self.images_in_progress.values())

    @property
    def rate_hz(self) -> float:
        """Images per second since the first model was loaded, of all workers together."""
        return 0.0 if self._begun_s is None else self.images / max(time.monotonic() - self._begun_s, 1e-9)

    @property
    def is_complete(self) -> bool:
        """Whether every recording has a result with all its images."""
        return not any(result.state == "set aside" or result.missing for result in self.results.values())

    def in_state(self, state: str) -> int:
        """How many recordings are in `state`."""
        return sum(result.state == state for result in self.results.values())


class RunWatch(Protocol):
    """Observer of a run over many recordings."""

    def remark(self, text: str) -> None:
        """Called for events that the user should know, such as a recording without a result."""

    def progress(self, tally: Tally) -> None:
        """Called about once a second with the totals so far."""


def detect_recordings(
    sources: Sequence[SourceRecording],
    plan: Plan,
    *,
    new_workers: Callable[[int], Workers],
    watch: RunWatch,
) -> Tally:
    """Write a result for each of `sources`, and a summary, to the folder `plan.output`.

    `new_workers` is called with the number of recordings that have no result yet, unless that is 0. Raises
    OutputError, OSError, and DetectingError if the model cannot be loaded or nothing more can be written.
    """
    tally = Tally(len(sources))
    with _output_folder(plan.output):
        waiting: deque[SourceRecording] = deque()
        for source in sources:
            finished = finished_before(source, plan)
            if finished is None:
                waiting.append(source)
            else:
                tally.add(finished)
        check_summary(plan.output)
        if waiting:
            with closing(new_workers(len(waiting))) as workers:
                _Run(waiting, plan, workers, tally, watch).run()
        results = [tally.results[source.name] for source in sources]
        for problem in write_summary(plan, results):
            watch.remark(problem)
    return tally


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
        remove_unfinished_outputs(folder)
        try:
            yield
        finally:
            remove_unfinished_outputs(folder)
            if is_new:
                with suppress(OSError):
                    folder.rmdir()
    finally:
        os.close(descriptor)


class _Run:
    """Hands out recordings and takes results, until none are left."""

    def __init__(
        self,
        waiting: deque[SourceRecording],
        plan: Plan,
        workers: Workers,
        tally: Tally,
        watch: RunWatch,
    ) -> None:
        self._waiting = waiting
        self._plan = plan
        self._workers = workers
        self._tally = tally
        self._watch = watch
        self._loading: set[int] = set()
        self._running: dict[int, SourceRecording] = {}
        self._idle: set[int] = set()
        self._deaths: Counter[str] = Counter()
        self._deaths_while_loading = 0
        self._was_ready = False
        self._max_count = workers.max_count

    def run(self) -> None:
        self._start()
        while self._waiting or self._running:
            for event in self._workers.events(_EVENT_S):
                self._handle(event)
            self._watch.progress(self._tally)

    def _start(self) -> None:
        """Start as many workers as have work; the first one alone if it has to choose for all."""
        wanted = min(self._max_count, len(self._waiting) + len(self._running))
        if self._plan.is_open:
            wanted = 1
        while len(self._loading) + len(self._running) + len(self._idle) < wanted:
            self._loading.add(self._workers.start(self._plan))

    def _handle(self, event: Event) -> None:
        if isinstance(event, Progress):
            self._tally.images_in_progress[event.worker] = event.images
            return
        self._tally.images_in_progress.pop(event.worker, None)
        if isinstance(event, Ready):
            self._loading.discard(event.worker)
            self._was_ready = True
            self._tally.begin()
            self._deaths_while_loading = 0
            self._plan = self._plan.model_copy(
                update={"runtime": event.runtime, "precision": event.precision}
            )
            self._idle.add(event.worker)
        elif isinstance(event, Ended):
            self._idle.add(event.worker)
            del self._running[event.worker]
            self._end(event.result)
        elif isinstance(event, Refused):
            self._refuse(event)
        else:
            self._handle_death(event)
        self._hand_out()

    def _hand_out(self) -> None:
        while self._waiting and self._idle:
            worker = self._idle.pop()
            self._running[worker] = self._waiting.popleft()
            self._workers.begin(worker, self._running[worker])
        if self._waiting:
            self._start()

    def _end(self, result: RecordingResult) -> None:
        self._tally.add(result)
        if result.state == "set aside":
            self._watch.remark(f"{result.recording}: set aside: {result.reason}")
        elif result.missing:
            claimed = result.images + result.missing
            self._watch.remark(f"{result.recording}: {missing_images(claimed, result.images)}")

    def _refuse(self, event: Refused) -> None:
        self._loading.discard(event.worker)
        others = len(self._loading) + len(self._running) + len(self._idle)
        if event.worker in self._running or not self._was_ready or not others:
            raise DetectingError(event.reason)
        self._max_count = others
        self._watch.remark(f"continuing with {others} worker(s): another one could not start: {event.reason}")

    def _handle_death(self, event: Died) -> None:
        self._idle.discard(event.worker)
        if event.worker in self._loading:
            self._loading.discard(event.worker)
            self._deaths_while_loading += 1
            if self._deaths_while_loading >= MAX_DEATHS:
                raise DetectingError(f"{event.reason} while loading the model, {MAX_DEATHS} times in a row")
        source = self._running.pop(event.worker, None)
        if source is None:
            return
        self._deaths[source.name] += 1
        if self._deaths[source.name] < MAX_DEATHS:
            self._watch.remark(f"{source.name}: {event.reason}; another worker retries it")
            self._waiting.appendleft(source)
        else:
            reason = f"{event.reason} {MAX_DEATHS} times while reading this recording"
            self._end(
                RecordingResult(
                    recording=source.name, path=str(source.path), state="set aside", reason=in_lines(reason)
                )
            )
