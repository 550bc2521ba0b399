"""`detect_bag` over many recordings: the results of single runs, each once, even if workers die."""

from __future__ import annotations

import errno
import json
import os
import shutil
import signal
import subprocess
import time
from pathlib import Path

import pytest
from pyarrow import parquet
from rosbags.rosbag2 import StoragePlugin
from support.detected_offline import SET_MODEL, prepare_once, run
from support.many_recordings import (
    LONG,
    HuntedWorker,
    Notes,
    broken,
    found_objects,
    messages,
    plan_for,
    record_drives,
    result_of,
)
from support.recorded_scene import COUNT, raw, record
from support.started import started

from yolov5_lifecycle.atomic_file import has_unfinished_outputs
from yolov5_lifecycle.offline.detect_bag import EXIT_INCOMPLETE, main
from yolov5_lifecycle.offline.many_recordings.recording_task import RecordingTask
from yolov5_lifecycle.offline.many_recordings.results import RECORD_NAME, Refused
from yolov5_lifecycle.offline.many_recordings.supervisor import detect_recordings
from yolov5_lifecycle.offline.many_recordings.tally import Tally
from yolov5_lifecycle.offline.many_recordings.workers import ProcessWorker
from yolov5_lifecycle.offline.recordings import SourceRecording, recordings_of
from yolov5_lifecycle.ros.child_process import entry_point
from yolov5_lifecycle.runtimes.runtime import DeviceLostError
from yolov5_lifecycle.sources.scene import CLASS_NAMES

LENGTHS = {"east": COUNT, "north": 4, "west": 5}


@pytest.fixture(scope="module")
def drives(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = record_drives(tmp_path_factory.mktemp("recorded") / "drives", LENGTHS)
    broken(folder, "south")
    return folder


@pytest.fixture(scope="module")
def found(drives: Path) -> Path:
    """The results of two workers."""
    output = drives.parent / "found"
    assert main([str(drives), "--output", str(output), "--jobs", "2", *SET_MODEL]) == EXIT_INCOMPLETE
    return output


@pytest.fixture
def again(found: Path, tmp_path: Path) -> Path:
    """The results, to be changed."""
    return Path(shutil.copytree(found, tmp_path / "found"))


def rows(folder: Path) -> dict[str, dict[str, object]]:
    """The rows of the summary by recording."""
    return {row["recording"]: row for row in json.loads((folder / "summary.json").read_text())["results"]}


def states(folder: Path) -> dict[str, object]:
    return {name: row["state"] for name, row in rows(folder).items()}


def identities(folder: Path) -> dict[str, int]:
    """The inode of each result: another one has been written again."""
    return {path.name: path.stat().st_ino for path in folder.iterdir() if path.is_dir()}


@pytest.mark.long
@pytest.mark.parametrize("name", LENGTHS)
def test_each_result_is_that_of_a_single_run(name: str, drives: Path, found: Path, tmp_path: Path) -> None:
    assert run([str(drives / name), "--output", str(tmp_path / name), *SET_MODEL]) == 0
    assert messages(found / name) == messages(tmp_path / name)
    files = {path.name for path in (tmp_path / name).iterdir()}
    assert {path.name for path in (found / name).iterdir()} == files | {RECORD_NAME}


@pytest.mark.long
def test_the_folder_of_results_has_nothing_else(found: Path) -> None:
    assert {path.name for path in found.iterdir()} == {*LENGTHS, "summary.json", "summary.parquet"}


def test_a_broken_recording_is_set_aside_with_its_reason(found: Path) -> None:
    row = rows(found)["south"]
    assert row["state"] == "set aside"
    assert "the recording cannot be read" in str(row["reason"])
    assert not (found / "south").exists()


def test_the_summary_counts_what_the_results_hold(found: Path) -> None:
    summary = json.loads((found / "summary.json").read_text())
    assert (summary["recordings"], summary["done"], summary["set_aside"]) == (4, 3, 1)
    assert summary["images"] == summary["detected"] == sum(LENGTHS.values())
    for name, count in LENGTHS.items():
        row = rows(found)[name]
        assert (row["images"], row["detected"], row["rejected"], row["failed"]) == (count, count, 0, 0)
        assert row["detections"] == dict.fromkeys(CLASS_NAMES, 0) | found_objects(found / name)
        assert row["runtime"] == "torch"


def test_the_table_has_the_rows_of_the_summary(found: Path) -> None:
    table = {row["recording"]: row for row in parquet.read_table(found / "summary.parquet").to_pylist()}
    for name, row in rows(found).items():
        detections = row.pop("detections")
        assert isinstance(detections, dict)
        for class_name in CLASS_NAMES:
            assert table[name].pop(f"detections/{class_name}") == detections.get(class_name)
        total = sum(detections.values()) if detections else None
        assert table[name] == {**row, "detections": total}


def test_a_second_run_does_only_what_is_missing(
    drives: Path, again: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = identities(again)
    words = [str(drives / name) for name in LENGTHS]
    assert main([*words, "--output", str(again), *SET_MODEL]) == 0
    assert capsys.readouterr().err.startswith("recordings  3: 0 done, 3 skipped, 0 set aside\n")
    assert identities(again) == before
    assert states(again) == dict.fromkeys(LENGTHS, "skipped")


@pytest.mark.long
def test_what_was_changed_is_done_again_and_what_was_only_touched_is_not(
    drives: Path, again: Path, tmp_path: Path
) -> None:
    copies = Path(shutil.copytree(drives, tmp_path / "drives"))
    os.utime(copies / "east" / "east.mcap", ns=(1, 1))
    shutil.rmtree(copies / "north")
    shutil.copytree(copies / "east", copies / "north")
    (again / "west" / "west.mcap").write_bytes(b"cut off")
    before = identities(again)
    words = [str(copies / name) for name in LENGTHS]
    assert main([*words, "--output", str(again), "--jobs", "1", *SET_MODEL]) == 0
    assert states(again) == {"east": "skipped", "north": "done", "west": "done"}
    after = identities(again)
    assert {name for name in LENGTHS if before[name] != after[name]} == {"north", "west"}
    assert messages(again / "north") == messages(again / "east")


@pytest.mark.long
def test_other_settings_make_other_results(drives: Path, again: Path) -> None:
    source = SourceRecording("east", drives / "east")
    assert result_of(source, plan_for(again)).state == "skipped"
    assert result_of(source, plan_for(again, classes=["star"])).state == "done"
    assert set(found_objects(again / "east")) == {"star"}
    assert not has_unfinished_outputs(again)


def test_a_recording_that_grows_while_it_is_read_is_set_aside(drives: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(drives / "east", tmp_path / "east"))
    plan = plan_for(tmp_path / "found")
    plan.output.mkdir()
    row = result_of(SourceRecording("east", copy), plan, lambda _: (copy / "more.mcap").touch())
    assert "it changed while it was read" in row.reason
    assert list(plan.output.iterdir()) == []


def test_images_that_cannot_be_read_are_counted_with_the_first_problem(tmp_path: Path) -> None:
    odd = [raw(0), raw(1, encoding="32FC1"), raw(2, encoding="32FC1")]
    source = SourceRecording("odd", record(tmp_path / "odd", odd, storage=StoragePlugin.MCAP))
    (tmp_path / "found").mkdir()
    result = result_of(source, plan_for(tmp_path / "found"))
    assert (result.images, result.detected, result.rejected) == (3, 1, 2)
    assert result.first_problem.startswith("1700000000.540000007: rejected: Encoding '32FC1'")


def test_a_lost_gpu_or_a_full_disk_sets_no_recording_aside(drives: Path, tmp_path: Path) -> None:
    def fail(error: Exception) -> RecordingTask:
        def on_image(_: int) -> None:
            raise error

        return RecordingTask(plan_for(tmp_path), on_image, prepare=prepare_once)

    source = SourceRecording("east", drives / "east")
    lost = RuntimeError("stopped")
    lost.__cause__ = DeviceLostError("the GPU is gone")
    with pytest.raises(DeviceLostError):
        fail(lost).run(source)
    refused = fail(OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))).run(source)
    assert isinstance(refused, Refused)
    assert "No space left" in refused.reason
    assert list(tmp_path.iterdir()) == []


@pytest.mark.long
def test_a_killed_worker_loses_nothing_and_nothing_is_written_twice(tmp_path: Path) -> None:
    drives = record_drives(tmp_path / "drives", {"long": LONG, "short": COUNT})
    output, notes = tmp_path / "found", Notes()
    begun: list[bool] = []
    worker = HuntedWorker(["long"], lambda: begun.append(has_unfinished_outputs(output)))
    tally = detect_recordings(
        recordings_of([drives], output), plan_for(output), new_workers=lambda _: [worker], terminal=notes
    )
    assert (worker.killed, begun) == (["long"], [True])
    (remark,) = notes.remarks
    assert remark == "long: the worker died (signal 9); another worker retries it"
    assert {result.recording: (result.state, result.images) for result in tally.results.values()} == {
        "long": ("done", LONG),
        "short": ("done", COUNT),
    }
    assert len([one for one in messages(output / "long") if one[0] == "/yolov5/detections"]) == LONG
    assert not has_unfinished_outputs(output)


@pytest.mark.long
def test_a_recording_that_kills_its_workers_is_set_aside(tmp_path: Path) -> None:
    drives = record_drives(tmp_path / "drives", {"deadly": LONG, "harmless": COUNT})
    output, notes = tmp_path / "found", Notes()
    tally = detect_recordings(
        recordings_of([drives], output),
        plan_for(output),
        new_workers=lambda _: [HuntedWorker(["deadly", "deadly"])],
        terminal=notes,
    )
    assert {name: result.state for name, result in tally.results.items()} == {
        "deadly": "set aside",
        "harmless": "done",
    }
    (remark,) = notes.aside
    assert remark == "deadly: set aside: the worker died (signal 9) 2 times while reading this recording"
    assert not (output / "deadly").exists()
    assert not has_unfinished_outputs(output)


def one_process(_: int) -> list[ProcessWorker]:
    return [ProcessWorker(1)]


@pytest.mark.long
def test_an_interrupt_leaves_nothing_unfinished_and_keeps_what_is_whole(tmp_path: Path) -> None:
    drives = record_drives(tmp_path / "drives", {"a": COUNT, "b": LONG})
    output = tmp_path / "found"

    def interrupt(tally: Tally) -> None:
        if tally.results and tally.images > COUNT:
            raise KeyboardInterrupt

    sources, plan = recordings_of([drives], output), plan_for(output)
    with pytest.raises(KeyboardInterrupt):
        detect_recordings(sources, plan, new_workers=one_process, terminal=Notes(interrupt))
    assert [path.name for path in output.iterdir()] == ["a"]
    detect_recordings(sources, plan, new_workers=one_process, terminal=Notes())
    assert states(output) == {"a": "skipped", "b": "done"}


@pytest.mark.long
def test_a_model_that_cannot_be_loaded_ends_the_command_and_leaves_nothing(
    drives: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [str(drives), "--output", str(tmp_path / "found"), *SET_MODEL, "--set", "classes=[circel]"]
    assert main(words) == 1
    assert "Did you mean 'circle'?" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.long
@pytest.mark.parametrize(
    ("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)], ids=["SIGINT", "SIGTERM"]
)
def test_a_signal_ends_all_workers_and_removes_what_is_unfinished(
    number: signal.Signals, code: int, tmp_path: Path
) -> None:
    drives = record_drives(tmp_path / "drives", {"a": 10 * LONG, "b": 10 * LONG})
    output = tmp_path / "found"
    words = [entry_point("detect_bag"), str(drives), "--output", str(output), "--jobs", "2", *SET_MODEL]
    with started(words, stderr=subprocess.PIPE, text=True) as process:
        while not (output.exists() and has_unfinished_outputs(output)):
            assert process.poll() is None
            time.sleep(0.01)
        process.send_signal(number)
        _, told = process.communicate(timeout=60)
    assert process.returncode == code, told
    assert not output.exists()


@pytest.mark.long
def test_workers_end_with_the_process_that_started_them_even_if_that_is_killed(tmp_path: Path) -> None:
    drives = record_drives(tmp_path / "drives", {"a": 10 * LONG})
    output = tmp_path / "found"
    words = [entry_point("detect_bag"), str(drives), "--output", str(output), *SET_MODEL]
    with started(words) as process:
        while not (output.exists() and has_unfinished_outputs(output)):
            assert process.poll() is None
            time.sleep(0.01)
        process.kill()
    while has_unfinished_outputs(output):  # until the time limit of the test
        time.sleep(0.01)
    assert list(output.iterdir()) == []
