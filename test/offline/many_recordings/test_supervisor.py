"""How recordings are handed out to workers that load, refuse, fail and die."""

from __future__ import annotations

import json
import os
from collections import Counter
from collections.abc import Callable
from multiprocessing.connection import Pipe
from pathlib import Path
from typing import Literal

import pytest
from support.many_recordings import plan_for

from yolov5_lifecycle.atomic_file import OutputError, hold, open_itself
from yolov5_lifecycle.offline.detecting import DetectingError, RunStatistics
from yolov5_lifecycle.offline.many_recordings import supervisor
from yolov5_lifecycle.offline.many_recordings.results import Batch, Plan, RecordingResult
from yolov5_lifecycle.offline.many_recordings.supervisor import (
    MAX_DEATHS,
    Worker,
    detect_recordings,
    suitable_count,
)
from yolov5_lifecycle.offline.recordings import SourceRecording
from yolov5_lifecycle.offline.terminal import Terminal, report
from yolov5_lifecycle.process.environment import compute_threads

SOURCES = [SourceRecording(name, Path("/drives", name)) for name in "abcd"]

Answer = Plan | RecordingResult | DetectingError | Literal["nothing yet"] | None
"""What a process sends; None: it dies."""


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


def loaded(plan: Plan) -> Answer:
    """What a worker answers that has loaded the model."""
    return plan.chosen("torch", "fp32")


def done(source: SourceRecording) -> Answer:
    """What a worker answers that has read two images."""
    return RecordingResult(recording=source.name, path=str(source.path), state="done", images=2)


class ScriptedWorker(Worker):
    """A worker whose process answers at once what the functions of `run` return."""

    def __init__(self, run: ScriptedRun) -> None:
        self.source = None
        self.connection, self._process_end = Pipe()
        self.tasks: list[Plan | SourceRecording] = []
        self.is_stopped = False
        self._run = run

    def send(self, task: Plan | SourceRecording) -> None:
        self.tasks.append(task)
        if isinstance(task, Plan):
            answer = self._run.on_load(task)
        else:
            self._process_end.send(1)
            answer = self._run.on_detect(task)
        if answer is None:
            self._process_end.close()
        elif answer != "nothing yet":
            self._process_end.send(answer)

    def stop(self) -> None:
        self.is_stopped = True

    def close(self) -> int:
        self.connection.close()
        return -9


class ScriptedRun:
    """A run in `folder` with scripted workers."""

    def __init__(
        self,
        folder: Path,
        jobs: int = 2,
        *,
        on_load: Callable[[Plan], Answer] = loaded,
        on_detect: Callable[[SourceRecording], Answer] = done,
        on_progress: Callable[[str], object] = lambda _: None,
    ) -> None:
        self.on_load, self.on_detect, self._jobs = on_load, on_detect, jobs
        self.notes = Notes(on_progress)
        self.workers: list[ScriptedWorker] = []
        self.plan = plan_for(folder / "found", runtime="auto")

    def run(self) -> Batch:
        return detect_recordings(
            SOURCES, self.plan, jobs=self._jobs, terminal=self.notes, new_worker=self._new_worker
        )

    def _new_worker(self, count: int) -> Worker:
        assert count == self._jobs
        self.workers.append(ScriptedWorker(self))
        return self.workers[-1]

    @property
    def plans(self) -> list[Plan]:
        return [task for worker in self.workers for task in worker.tasks if isinstance(task, Plan)]

    @property
    def begun(self) -> list[str]:
        """The recordings that were begun, in alphabetical order."""
        tasks = [task for worker in self.workers for task in worker.tasks]
        return sorted(task.name for task in tasks if isinstance(task, SourceRecording))

    @property
    def all_have_ended(self) -> bool:
        return all(worker.is_stopped and worker.connection.closed for worker in self.workers)


def test_the_first_worker_chooses_runtime_and_precision_of_all(tmp_path: Path) -> None:
    scripted = ScriptedRun(tmp_path, 3)
    batch = scripted.run()
    assert [plan.settings.runtime for plan in scripted.plans] == ["auto", "torch", "torch"]
    assert [plan.settings.precision for plan in scripted.plans] == ["auto", "fp32", "fp32"]
    assert scripted.all_have_ended
    assert scripted.begun == list("abcd")
    assert (batch.states["done"], batch.images) == (4, 8)


def test_the_recording_of_a_dead_worker_is_retried_until_it_fails(tmp_path: Path) -> None:
    deaths = ["a", "b", "b", "c"]

    def detect(source: SourceRecording) -> Answer:
        if source.name not in deaths:
            return done(source)
        deaths.remove(source.name)
        return None

    scripted = ScriptedRun(tmp_path, on_detect=detect)
    assert scripted.run().states == {"done": 3, "skipped": 0, "failed": 1}
    assert scripted.begun == list("aabbccd")
    died = "the worker died (signal 9)"
    assert sorted(scripted.notes.told) == [
        f"a: {died}; another worker retries it",
        f"b: failed: {died} {MAX_DEATHS} times while reading this recording",
        f"b: {died}; another worker retries it",
        f"c: {died}; another worker retries it",
    ]


@pytest.mark.parametrize(
    ("answer", "told"),
    [
        pytest.param(None, r"^the worker died \(signal 9\) while loading the model$", id="dies"),
        pytest.param(DetectingError("no such class"), "^no such class$", id="refuses"),
    ],
)
def test_a_model_that_no_worker_can_load_ends_the_run(answer: Answer, told: str, tmp_path: Path) -> None:
    scripted = ScriptedRun(tmp_path, on_load=lambda _: answer)
    with pytest.raises(DetectingError, match=told):
        scripted.run()
    assert scripted.all_have_ended
    assert (scripted.begun, scripted.notes.told) == ([], [])
    assert not scripted.plan.output.exists()
    scripted.plan.output.mkdir()  # by the user, so that it stays
    with pytest.raises(DetectingError, match=told):
        scripted.run()
    assert scripted.plan.output.is_dir()


def test_another_worker_that_dies_before_or_after_the_first_has_loaded_the_model_ends_the_run(
    tmp_path: Path,
) -> None:
    before = ScriptedRun(
        tmp_path,
        on_load=lambda _: "nothing yet",
        on_progress=lambda _: before.workers[1]._process_end.close(),
    )
    after = ScriptedRun(
        tmp_path, on_load=lambda plan: loaded(plan) if plan.settings.runtime == "auto" else None
    )
    for scripted in (before, after):
        with pytest.raises(DetectingError, match=r"another worker could not start: .*give a smaller --jobs"):
            scripted.run()
        assert scripted.all_have_ended


def test_the_run_ends_with_the_last_result_even_if_another_worker_still_loads_the_model(
    tmp_path: Path,
) -> None:
    scripted = ScriptedRun(
        tmp_path, on_load=lambda plan: loaded(plan) if plan.settings.runtime == "auto" else "nothing yet"
    )
    assert scripted.run().states["done"] == len(SOURCES)
    assert scripted.all_have_ended


def test_an_interrupt_ends_all_workers(tmp_path: Path) -> None:
    def interrupt(shown: str) -> None:
        if ", 0 images" not in shown:
            raise KeyboardInterrupt

    scripted = ScriptedRun(tmp_path, 3, on_progress=interrupt)
    with pytest.raises(KeyboardInterrupt):
        scripted.run()
    assert len(scripted.begun) <= 3
    assert scripted.all_have_ended


def test_a_recording_that_lacks_images_is_told(tmp_path: Path) -> None:
    def incomplete(source: SourceRecording) -> Answer:
        counts = {"images": 2, "missing": 3 * (source.name == "b")}
        return RecordingResult(recording=source.name, path=str(source.path), state="done", **counts)

    scripted = ScriptedRun(tmp_path, on_detect=incomplete)
    assert not scripted.run().is_complete
    (told,) = scripted.notes.told
    assert told.startswith("b: the recording claims 5 images, but has 2")


def test_a_result_that_was_finished_before_its_worker_died_counts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def finished(source: SourceRecording, plan: Plan) -> RecordingResult | None:
        row = RecordingResult(recording=source.name, path=str(source.path), state="skipped", images=2)
        return row if scripted.begun.count(source.name) == MAX_DEATHS else None

    scripted = ScriptedRun(tmp_path, on_detect=lambda _: None)
    monkeypatch.setattr(supervisor, "finished_before", finished)
    batch = scripted.run()
    assert (batch.states, batch.images) == ({"done": 0, "skipped": 4, "failed": 0}, 0)


def test_a_full_disk_ends_the_run(tmp_path: Path) -> None:
    scripted = ScriptedRun(tmp_path, on_detect=lambda _: DetectingError("No space left on device"))
    with pytest.raises(DetectingError, match=r"^No space left"):
        scripted.run()


def test_two_batches_do_not_share_a_folder(tmp_path: Path) -> None:
    scripted = ScriptedRun(tmp_path)
    scripted.plan.output.mkdir()
    held = open_itself(scripted.plan.output)
    assert hold(held, scripted.plan.output)
    with pytest.raises(OutputError, match="another detect_bag is writing to it"):
        scripted.run()
    assert scripted.workers == []
    os.close(held)


def summaries(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_the_old_summary_stays_until_the_new_one_is_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ScriptedRun(tmp_path).run()
    before = summaries(tmp_path / "found")
    assert json.loads(before["summary.json"])["states"]["done"] == 4
    with pytest.raises(DetectingError, match="no memory"):
        ScriptedRun(tmp_path, on_load=lambda _: DetectingError("no memory")).run()
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
