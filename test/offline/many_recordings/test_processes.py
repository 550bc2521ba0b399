"""`detect_bag` over many recordings: the results of single runs, each once, even if processes are killed."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from support.detected_offline import SET_MODEL, run
from support.many_recordings import (
    LONG,
    found_objects,
    messages,
    plan_for,
    record_drives,
    rows,
)
from support.recorded_scene import COUNT, video
from support.started import started

from yolov5_lifecycle.atomic_file import FOLDER_PREFIX
from yolov5_lifecycle.offline.detect_bag import EXIT_INCOMPLETE, main
from yolov5_lifecycle.offline.detecting import DetectingError
from yolov5_lifecycle.offline.many_recordings.results import RECORD_NAME, Plan, RecordingResult
from yolov5_lifecycle.offline.many_recordings.supervisor import Worker, detect_recordings
from yolov5_lifecycle.offline.recordings import recordings_of
from yolov5_lifecycle.offline.terminal import Terminal
from yolov5_lifecycle.ros.child_process import entry_point
from yolov5_lifecycle.sources.scene import CLASS_NAMES

LENGTHS = {"east": COUNT, "north": 4}


@pytest.fixture(scope="module")
def drives(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two recordings, a broken one, a video and something else."""
    folder = record_drives(tmp_path_factory.mktemp("recorded") / "drives", LENGTHS)
    (folder / "south").mkdir()
    (folder / "south" / "south.mcap").write_bytes(b"these are no messages")
    video(folder / "film.avi")
    (folder / "notes.txt").write_text("nothing")
    return folder


@pytest.fixture(scope="module")
def found(drives: Path) -> Path:
    """The results of the command."""
    output = drives.parent / "found"
    assert (
        main([str(drives), "--output", str(output), "--jobs", "1", "--track", *SET_MODEL]) == EXIT_INCOMPLETE
    )
    return output


def test_each_result_is_that_of_a_single_run(drives: Path, found: Path, tmp_path: Path) -> None:
    for name in LENGTHS:
        assert run([str(drives / name), "--output", str(tmp_path / name), "--track", *SET_MODEL]) == 0
        assert messages(found / name) == messages(tmp_path / name)
        files = {path.name for path in (tmp_path / name).iterdir()}
        assert {path.name for path in (found / name).iterdir()} == files | {RECORD_NAME}
    lines = tmp_path / "film.jsonl"
    assert run([str(drives / "film.avi"), "--output", str(lines), "--track", *SET_MODEL]) == 0
    assert (found / "film" / "detections.jsonl").read_text() == lines.read_text()
    results = {*LENGTHS, "film", "summary.json"}
    assert {path.name for path in found.iterdir()} == results


def test_the_summary_counts_what_the_results_hold(found: Path) -> None:
    summary = json.loads((found / "summary.json").read_text())
    assert (summary["recordings"], summary["states"]) == (4, {"done": 3, "skipped": 0, "failed": 1})
    assert summary["images"] == summary["detected"] == sum(LENGTHS.values()) + COUNT
    for name, count in LENGTHS.items():
        row = rows(found)[name]
        assert (row["images"], row["detected"], row["rejected"], row["failed"]) == (count, count, 0, 0)
        assert row["detections"] == dict.fromkeys(CLASS_NAMES, 0) | found_objects(found / name)
        assert row["runtime"] == "torch"
    south = rows(found)["south"]
    assert south["state"] == "failed"
    assert "the recording cannot be read" in south["reason"]


@pytest.mark.long
def test_a_worker_says_why_it_cannot_load_the_model(tmp_path: Path) -> None:
    worker = Worker(1)
    worker.send(plan_for(tmp_path, classes=["circel"]))
    with pytest.raises(DetectingError, match=r"Did you mean 'circle'\?"):
        worker.answer()
    assert worker.close() == 1


@pytest.mark.long
def test_a_worker_that_died_before_it_got_the_model_is_told(tmp_path: Path) -> None:
    worker = Worker(1)
    worker.stop()
    worker._process.wait()
    worker.send(plan_for(tmp_path))
    with pytest.raises(DetectingError, match=r"died \(signal 15\) while loading the model"):
        worker.answer()


def has_unfinished_outputs(folder: Path) -> bool:
    """Whether a process is writing output to `folder`, or was killed while doing so."""
    return any(path.name.startswith(FOLDER_PREFIX) for path in folder.iterdir())


class HuntedWorker(Worker):
    """The first of all is killed when it has read the first image of a recording."""

    killed = ""

    def answer(self) -> Plan | int | RecordingResult:
        answer = super().answer()
        if self.source is not None and not HuntedWorker.killed:
            HuntedWorker.killed = self.source.name
            self._process.kill()
        return answer


@pytest.mark.long
def test_a_killed_worker_loses_nothing_and_nothing_is_written_twice(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lengths = {"a": LONG, "b": LONG}
    drives = record_drives(tmp_path / "drives", lengths)
    output, terminal = tmp_path / "found", Terminal("detect_bag", shows_progress=True)
    batch = detect_recordings(
        recordings_of([drives], output), plan_for(output), jobs=2, terminal=terminal, new_worker=HuntedWorker
    )
    told = capsys.readouterr().err
    assert (
        f"detect_bag: {HuntedWorker.killed}: the worker died (signal 9); another worker retries it\n" in told
    )
    assert {name: row.images for name, row in batch.results.items() if row.state == "done"} == lengths
    for name in lengths:
        assert run([str(drives / name), "--output", str(tmp_path / name), *SET_MODEL]) == 0
        assert messages(output / name) == messages(tmp_path / name)
    assert not has_unfinished_outputs(output)


@pytest.mark.long
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL], ids=lambda one: one.name)
def test_a_signal_ends_the_worker_removes_what_is_unfinished_and_keeps_what_is_whole(
    number: signal.Signals, tmp_path: Path
) -> None:
    drives = record_drives(tmp_path / "drives", {"a": COUNT, "b": 10 * LONG})
    output = tmp_path / "found"
    words = [entry_point("detect_bag"), str(drives), "--output", str(output), "--jobs", "1", *SET_MODEL]
    with started(words, stderr=subprocess.PIPE, text=True) as process:
        while not ((output / "a").exists() and has_unfinished_outputs(output)):
            with pytest.raises(subprocess.TimeoutExpired):
                process.wait(0.01)
        process.send_signal(number)
        _, told = process.communicate(timeout=60)  # until its worker has ended, too
    assert process.returncode == (-number if number == signal.SIGKILL else 128 + number), told
    assert not has_unfinished_outputs(output)
    assert [path.name for path in output.iterdir()] == ["a"]


@pytest.mark.long
def test_videos_need_no_rosbags_and_a_broken_one_fails_alone(drives: Path, tmp_path: Path) -> None:
    (tmp_path / "broken.mp4").write_bytes(b"no video")
    program = (
        "import sys; sys.modules['rosbags'] = None; "
        "from yolov5_lifecycle.offline.detect_bag import main; sys.exit(main(sys.argv[1:]))"
    )
    words = [str(drives / "film.avi"), str(tmp_path / "broken.mp4"), "--output", str(tmp_path / "found")]
    command = [sys.executable, "-c", program, *words, "--jobs", "1", *SET_MODEL]
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    assert ended.returncode == EXIT_INCOMPLETE, ended.stderr
    states = {name: row["state"] for name, row in rows(tmp_path / "found").items()}
    assert states == {"film": "done", "broken": "failed"}
    assert "broken: failed: " in ended.stderr
