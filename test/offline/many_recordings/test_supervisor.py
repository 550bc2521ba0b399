"""How recordings are handed out to workers that load, refuse, fail and die."""

from __future__ import annotations

import json
import os
import threading
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from support.many_recordings import plan_for

from yolov5_lifecycle.atomic_file import OutputError, hold, open_itself
from yolov5_lifecycle.offline.detecting import DetectingError, RunStatistics
from yolov5_lifecycle.offline.many_recordings.recording_task import OnImage
from yolov5_lifecycle.offline.many_recordings.results import Batch, Plan, RecordingResult
from yolov5_lifecycle.offline.many_recordings.supervisor import MAX_DEATHS, detect_recordings
from yolov5_lifecycle.offline.many_recordings.workers import Worker, suitable_count
from yolov5_lifecycle.offline.recordings import SourceRecording
from yolov5_lifecycle.offline.terminal import Terminal, report
from yolov5_lifecycle.process.environment import compute_threads

PATIENCE_S = 60.0
SOURCES = [SourceRecording(name, Path("/drives", name)) for name in "abcd"]


class Notes(Terminal):
    """Remembers what it is told; `on_progress` is called with what it shows."""

    def __init__(self, on_progress: Callable[[str], object]) -> None:
        super().__init__("detect_bag", shows_progress=False)
        self.told: list[str] = []
        self._on_progress = on_progress

    def tell(self, problem: str) -> None:
        self.told.append(problem)

    def show(self, text: str) -> None:
        self._on_progress(text)


class ScriptedWorker(Worker):
    """A worker that answers what `on_load` and `on_detect` return for it, unless they raise."""

    def __init__(
        self,
        on_load: Callable[[ScriptedWorker, Plan], Plan],
        on_detect: Callable[[ScriptedWorker, SourceRecording], RecordingResult],
    ) -> None:
        self.plans: list[Plan] = []
        self.begun: list[str] = []
        self.stopped = threading.Event()
        self.is_closed = False
        self._on_load, self._on_detect = on_load, on_detect

    def load(self, plan: Plan) -> Plan:
        self.plans.append(plan)
        return self._on_load(self, plan)

    def detect(self, source: SourceRecording, on_image: OnImage) -> RecordingResult:
        self.begun.append(source.name)
        on_image(1)
        return self._on_detect(self, source)

    def start(self) -> None:
        if self.stopped.is_set():
            raise ChildProcessError("the worker was stopped")

    def stop(self) -> None:
        self.stopped.set()

    def close(self) -> None:
        self.is_closed = True


def loaded(worker: ScriptedWorker, plan: Plan) -> Plan:
    """What a worker answers that has loaded the model."""
    return plan.chosen("torch", "fp32")


def done(worker: ScriptedWorker, source: SourceRecording) -> RecordingResult:
    """What a worker answers that has read two images."""
    return RecordingResult(recording=source.name, path=str(source.path), state="done", images=2)


class ScriptedRun:
    """A run in `folder` with scripted workers."""

    def __init__(
        self,
        folder: Path,
        count: int = 2,
        *,
        on_load: Callable[[ScriptedWorker, Plan], Plan] = loaded,
        on_detect: Callable[[ScriptedWorker, SourceRecording], RecordingResult] = done,
        on_progress: Callable[[str], object] = lambda _: None,
        **settings: Any,
    ) -> None:
        self.notes = Notes(on_progress)
        self.workers = [ScriptedWorker(on_load, on_detect) for _ in range(count)]
        self.plan = plan_for(folder / "found", **({"runtime": "auto"} | settings))

    def run(self) -> Batch:
        return detect_recordings(SOURCES, self.plan, new_workers=lambda _: self.workers, terminal=self.notes)

    @property
    def begun(self) -> list[str]:
        """The recordings that were begun, in alphabetical order."""
        return sorted(name for worker in self.workers for name in worker.begun)


def test_the_first_worker_chooses_runtime_and_precision_of_all(tmp_path: Path) -> None:
    scripted = ScriptedRun(tmp_path, 3)
    batch = scripted.run()
    settings = [plan.settings for worker in scripted.workers for plan in worker.plans]
    assert [one.runtime for one in settings] == ["auto", "torch", "torch"]
    assert [one.precision for one in settings] == ["auto", "fp32", "fp32"]
    assert all(worker.stopped.is_set() and worker.is_closed for worker in scripted.workers)
    assert scripted.begun == list("abcd")
    assert (batch.states["done"], batch.images) == (4, 8)


def test_the_recording_of_a_dead_worker_is_retried_until_it_fails(tmp_path: Path) -> None:
    deaths = ["a", "b", "b", "c"]

    def detect(worker: ScriptedWorker, source: SourceRecording) -> RecordingResult:
        if source.name in deaths:
            deaths.remove(source.name)
            raise ChildProcessError("the worker died (signal 9)")
        return done(worker, source)

    scripted = ScriptedRun(tmp_path, on_detect=detect)
    assert scripted.run().states == {"done": 3, "skipped": 0, "failed": 1}
    assert scripted.begun == list("aabbccd")
    reason = f"the worker died (signal 9) {MAX_DEATHS} times while reading this recording"
    assert sorted(scripted.notes.told) == [
        "a: the worker died (signal 9); another worker retries it",
        f"b: failed: {reason}",
        "b: the worker died (signal 9); another worker retries it",
        "c: the worker died (signal 9); another worker retries it",
    ]


@pytest.mark.parametrize(
    ("answer", "told"),
    [
        pytest.param(ChildProcessError("it died"), "it died while loading the model", id="dies"),
        pytest.param(DetectingError("no such class"), "no such class", id="refuses"),
    ],
)
def test_a_model_that_no_worker_can_load_ends_the_run(answer: Exception, told: str, tmp_path: Path) -> None:
    def load(worker: ScriptedWorker, plan: Plan) -> Plan:
        raise answer

    scripted = ScriptedRun(tmp_path, on_load=load)
    with pytest.raises(DetectingError, match=told):
        scripted.run()
    assert all(worker.is_closed for worker in scripted.workers)
    assert (scripted.begun, scripted.notes.told) == ([], [])
    assert not scripted.plan.output.exists()
    scripted.plan.output.mkdir()  # by the user, so that it stays
    with pytest.raises(DetectingError, match=told):
        scripted.run()
    assert scripted.plan.output.is_dir()


def test_a_worker_that_cannot_load_the_model_ends_the_run(tmp_path: Path) -> None:
    def load(worker: ScriptedWorker, plan: Plan) -> Plan:
        if plan.settings.runtime != "auto":
            raise ChildProcessError("it died")
        return loaded(worker, plan)

    def detect(worker: ScriptedWorker, source: SourceRecording) -> RecordingResult:
        if source.name == "a":
            raise ChildProcessError("it died")
        return done(worker, source)

    scripted = ScriptedRun(tmp_path, 1, on_load=load, on_detect=detect)
    with pytest.raises(
        DetectingError, match=r"another worker could not start: it died .*give a smaller --jobs"
    ):
        scripted.run()
    assert all(worker.is_closed for worker in scripted.workers)


def test_an_interrupt_ends_workers_and_whatever_waits_for_one(tmp_path: Path) -> None:
    def detect(worker: ScriptedWorker, source: SourceRecording) -> RecordingResult:
        assert worker.stopped.wait(PATIENCE_S)
        raise ChildProcessError("it died")

    def interrupt(shown: str) -> None:
        if ", 0 images" not in shown:
            raise KeyboardInterrupt

    scripted = ScriptedRun(tmp_path, 3, on_detect=detect, on_progress=interrupt)
    with pytest.raises(KeyboardInterrupt):
        scripted.run()
    assert len(scripted.begun) <= 3
    assert all(worker.stopped.is_set() and worker.is_closed for worker in scripted.workers)
    assert scripted.notes.told == []


def test_a_full_disk_ends_the_run(tmp_path: Path) -> None:
    def detect(worker: ScriptedWorker, source: SourceRecording) -> RecordingResult:
        raise DetectingError("No space left on device")

    scripted = ScriptedRun(tmp_path, on_detect=detect)
    with pytest.raises(DetectingError, match="No space left"):
        scripted.run()


def test_two_batches_do_not_share_a_folder(tmp_path: Path) -> None:
    scripted = ScriptedRun(tmp_path)
    scripted.plan.output.mkdir()
    held = open_itself(scripted.plan.output)
    assert hold(held, scripted.plan.output)
    with pytest.raises(OutputError, match="another detect_bag is writing to it"):
        scripted.run()
    assert scripted.workers[0].plans == []
    os.close(held)


def no_memory(worker: ScriptedWorker, plan: Plan) -> Plan:
    raise DetectingError("no memory")


def summaries(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_the_old_summary_stays_until_the_new_one_is_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ScriptedRun(tmp_path).run()
    before = summaries(tmp_path / "found")
    assert json.loads(before["summary.json"])["states"]["done"] == 4
    with pytest.raises(DetectingError, match="no memory"):
        ScriptedRun(tmp_path, on_load=no_memory).run()
    assert summaries(tmp_path / "found") == before

    def full(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left"):
        ScriptedRun(tmp_path).run()
    assert summaries(tmp_path / "found") == before


def test_names_in_a_report_are_one_line_without_escapes() -> None:
    def line(**objects: int) -> str:
        return report(RunStatistics(0).counts, Counter(objects), expected=0).partition("\n")[2]

    odd = line(**{"\x1b[2K\rERROR": 2, "a\nb": 1, "\u202eabc": 1})
    assert odd.count("\n") == 1
    assert odd.rstrip("\n").isprintable()
    assert len(line(**{"x" * 200 + str(number): 1 for number in range(10_000)})) < 10_100
    assert str(Batch(0)).count("\n") == 4


@pytest.mark.parametrize(
    ("recordings", "jobs", "count"), [(1, None, 1), (10_000, None, compute_threads()), (3, 7, 3), (9, 7, 7)]
)
def test_there_are_no_more_workers_than_recordings_jobs_and_cores(
    recordings: int, jobs: int | None, count: int
) -> None:
    assert 1 <= suitable_count(recordings, jobs) <= count
    assert jobs is None or suitable_count(recordings, jobs) == count
