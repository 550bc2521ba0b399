"""How recordings are handed out to workers that load, refuse, fail and die."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from support.many_recordings import Notes, ScriptedWorkers, plan_for

from yolov5_lifecycle.atomic_file import OutputError
from yolov5_lifecycle.offline.detect_bag import main
from yolov5_lifecycle.offline.detecting import DetectingError
from yolov5_lifecycle.offline.many_recordings.plan import Plan
from yolov5_lifecycle.offline.many_recordings.recording_result import RecordingResult
from yolov5_lifecycle.offline.many_recordings.supervisor import MAX_DEATHS, Tally, detect_recordings
from yolov5_lifecycle.offline.many_recordings.worker_pool import ProcessWorkers, suitable_count
from yolov5_lifecycle.offline.many_recordings.workers import Died, Ended, Event, Ready, Refused
from yolov5_lifecycle.offline.recordings import SourceRecording
from yolov5_lifecycle.process.environment import compute_threads
from yolov5_lifecycle.unfinished import hold, open_itself

SOURCES = [SourceRecording(name, Path("/drives", name)) for name in "abcd"]


def ready(worker: int, plan: Plan) -> Event:
    return Ready(worker, "torch", "fp32")


def done(worker: int, source: SourceRecording) -> Event:
    return Ended(
        worker, RecordingResult(recording=source.name, path=str(source.path), state="done", images=2)
    )


class ScriptedRun:
    """A run in `folder` with scripted workers."""

    def __init__(
        self,
        folder: Path,
        max_count: int = 2,
        *,
        on_start: Callable[[int, Plan], Event] = ready,
        on_begin: Callable[[int, SourceRecording], Event] = done,
    ) -> None:
        self.output = folder / "found"
        self.notes = Notes()
        self.workers = ScriptedWorkers(max_count, on_start, on_begin)

    def run(self) -> Tally:
        return detect_recordings(
            SOURCES,
            plan_for(self.output, runtime="auto"),
            new_workers=lambda _: self.workers,
            watch=self.notes,
        )


def test_the_first_worker_chooses_runtime_and_precision_of_all(tmp_path: Path) -> None:
    scripted = ScriptedRun(tmp_path, 3)
    tally = scripted.run()
    assert scripted.workers.runtimes == ["auto", "torch", "torch"]
    assert scripted.workers.precisions == ["auto", "fp32", "fp32"]
    assert scripted.workers.is_closed
    assert sorted(name for _, name in scripted.workers.begun) == list("abcd")
    assert (tally.in_state("done"), tally.images) == (4, 8)


def test_with_runtime_and_precision_set_all_workers_start_at_once(tmp_path: Path) -> None:
    begun: list[int] = []

    def begin(worker: int, source: SourceRecording) -> Event:
        begun.append(len(scripted.workers.runtimes))
        return done(worker, source)

    scripted = ScriptedRun(tmp_path, 3, on_begin=begin)
    plan = plan_for(scripted.output, precision="fp32")
    detect_recordings(SOURCES, plan, new_workers=lambda _: scripted.workers, watch=scripted.notes)
    assert begun[0] == 3


def test_there_are_no_more_workers_than_recordings(tmp_path: Path) -> None:
    scripted = ScriptedRun(tmp_path, 100)
    scripted.run()
    assert len(scripted.workers.runtimes) == len(SOURCES)


def test_the_recording_of_a_dead_worker_is_retried(tmp_path: Path) -> None:
    deaths = ["a", "c"]

    def begin(worker: int, source: SourceRecording) -> Event:
        if source.name in deaths:
            deaths.remove(source.name)
            return Died(worker, "the worker died (signal 9)")
        return done(worker, source)

    scripted = ScriptedRun(tmp_path, on_begin=begin)
    assert scripted.run().in_state("done") == 4
    assert sorted(name for _, name in scripted.workers.begun) == list("aabccd")
    assert len(scripted.notes.remarks) == 2


def test_the_recording_at_which_workers_die_is_set_aside(tmp_path: Path) -> None:
    def begin(worker: int, source: SourceRecording) -> Event:
        return Died(worker, "it died") if source.name == "b" else done(worker, source)

    scripted = ScriptedRun(tmp_path, on_begin=begin)
    tally = scripted.run()
    assert (tally.in_state("done"), tally.in_state("set aside")) == (3, 1)
    assert [remark.split(":")[0] for remark in scripted.notes.aside] == ["b"]
    assert [name for _, name in scripted.workers.begun].count("b") == MAX_DEATHS


@pytest.mark.parametrize(
    ("event", "told"),
    [
        pytest.param(lambda worker: Died(worker, "it died"), "it died while loading the model", id="dies"),
        pytest.param(lambda worker: Refused(worker, "no such class"), "no such class", id="refuses"),
    ],
)
def test_a_model_that_no_worker_can_load_ends_the_run(
    event: Callable[[int], Event], told: str, tmp_path: Path
) -> None:
    scripted = ScriptedRun(tmp_path, on_start=lambda worker, _: event(worker))
    with pytest.raises(DetectingError, match=told):
        scripted.run()
    assert scripted.workers.is_closed
    assert not scripted.output.exists()


def test_a_worker_for_which_there_is_no_room_is_left_out(tmp_path: Path) -> None:
    def start(worker: int, plan: Plan) -> Event:
        return Refused(worker, "not enough memory") if worker else ready(worker, plan)

    scripted = ScriptedRun(tmp_path, 2, on_start=start)
    assert scripted.run().in_state("done") == 4
    (remark,) = scripted.notes.remarks
    assert remark == "continuing with 1 worker(s): another one could not start: not enough memory"


def test_a_full_disk_ends_the_run(tmp_path: Path) -> None:
    scripted = ScriptedRun(tmp_path, on_begin=lambda worker, _: Refused(worker, "No space left on device"))
    with pytest.raises(DetectingError, match="No space left"):
        scripted.run()


def test_two_batches_do_not_share_a_folder(tmp_path: Path) -> None:
    scripted = ScriptedRun(tmp_path)
    scripted.output.mkdir()
    held = open_itself(scripted.output)
    assert hold(held, scripted.output)
    with pytest.raises(OutputError, match="another detect_bag is writing to it"):
        scripted.run()
    assert scripted.workers.runtimes == []


def test_without_pyarrow_the_table_is_missing_and_the_remedy_is_given(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    scripted = ScriptedRun(tmp_path)
    scripted.run()
    assert [path.name for path in scripted.output.iterdir()] == ["summary.json"]
    assert json.loads((scripted.output / "summary.json").read_text())["done"] == 4
    (remark,) = scripted.notes.remarks
    assert remark.endswith("-m pip install pyarrow")


@pytest.mark.parametrize(("recordings", "count"), [(1, 1), (10_000, compute_threads())])
def test_a_machine_has_no_more_workers_than_cores_and_recordings(recordings: int, count: int) -> None:
    assert 1 <= suitable_count(recordings) <= count


def test_workers_share_the_cores() -> None:
    for count in (1, 2, 1000):
        workers = ProcessWorkers(count)
        assert workers.threads == max(1, compute_threads() // count)
        workers.close()


@pytest.mark.parametrize(
    ("words", "told"),
    [
        pytest.param(["a", "b"], "give --output, the folder for the results", id="no output"),
        pytest.param(["a", "b", "--output", "x", "--annotated", "y"], "use --images", id="drawings"),
        pytest.param(
            ["a", "--jobs", "0", "--output", "x"], "expected a number of processes from 1 to", id="no jobs"
        ),
        pytest.param(["a", "--jobs", "many", "--output", "x"], ", found 'many'", id="word"),
    ],
)
def test_wrong_usage_is_one_line(words: list[str], told: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stopped:
        main(words)
    assert stopped.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert told in line


@pytest.mark.parametrize(
    ("words", "told"),
    [
        pytest.param(["nothing", "drive"], "nothing: file or folder not found", id="missing"),
        pytest.param(
            ["drive", "--jobs", "1", "--output", "no/x"], "folder not found; create it", id="no folder"
        ),
        pytest.param(["drive", "--jobs", "1", "--output", "file"], "file is not a folder", id="file"),
        pytest.param(
            ["copy.mcap", "--jobs", "1", "--output", "drive"], "drive is a recording", id="recording"
        ),
        pytest.param(["drive", "--ray", "127.0.0.1:1"], "no Ray cluster answers", id="no cluster"),
        pytest.param(
            ["drive", "--jobs", "1", "--set", "weights_sha256=" + "f" * 64], "its sha256 is", id="pin"
        ),
    ],
)
def test_an_error_says_what_to_do_and_leaves_nothing_behind(
    words: list[str],
    told: str,
    drive: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(drive.parent)
    Path("file").touch()
    Path("copy.mcap").touch()
    before = sorted(drive.parent.rglob("*"))
    weights = plan_for(drive).weights
    assert main(["--output", "found", *words, "--set", f"weights={weights}"]) == 1
    assert told in capsys.readouterr().err
    assert sorted(drive.parent.rglob("*")) == before


def test_without_ray_the_option_says_how_to_install_it(
    drive: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    weights = plan_for(drive).weights
    words = [str(drive), "--output", str(drive.parent / "found"), "--ray", "auto"]
    assert main([*words, "--set", f"weights={weights}"]) == 1
    assert "-m pip install ray" in capsys.readouterr().err
