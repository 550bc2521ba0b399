"""The result of each of many recordings: when it is made again, and what is never replaced."""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from support.detected_offline import SET_MODEL, prepare_once
from support.many_recordings import plan_for, record_drives, result_of, rows
from support.onnx_exports import small_export
from support.recorded_scene import raw, record, video
from support.refusals import Refused

from yolov5_lifecycle.offline.detect_bag import main
from yolov5_lifecycle.offline.detecting import DetectingError
from yolov5_lifecycle.offline.export.exporting import Export
from yolov5_lifecycle.offline.export.formats import FORMATS
from yolov5_lifecycle.offline.many_recordings.recording_task import RecordingTask
from yolov5_lifecycle.offline.many_recordings.results import (
    RECORD_NAME,
    RecordingResult,
    finished_before,
    origin,
    plan_of,
)
from yolov5_lifecycle.offline.recordings import SourceRecording
from yolov5_lifecycle.quantization.calibration_file import path_beside
from yolov5_lifecycle.runtimes.runtime import DeviceLostError
from yolov5_lifecycle.settings.settings import validated


@pytest.fixture(scope="module")
def drives(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = record_drives(tmp_path_factory.mktemp("recorded") / "drives", {"east": 2})
    video(folder / "film.avi")
    return folder


def test_what_was_made_from_something_else_is_not_replaced(drives: Path, tmp_path: Path) -> None:
    source, east = drives / "east", tmp_path / "east"
    assert result_of(source, plan_for(tmp_path)).state == "done"
    before = {path: path.read_bytes() for path in east.iterdir()}
    assert result_of(source, plan_for(tmp_path)).state == "skipped"
    result = result_of(source, plan_for(tmp_path, classes=["star"]))
    assert result.state == "failed"
    assert result.reason.startswith(f"{east} exists and is not replaced, as it was made from other weights,")
    assert "remove it, or choose another --output" in result.reason
    assert {path: path.read_bytes() for path in east.iterdir()} == before


def test_the_summary_of_another_program_is_not_replaced(
    drives: Path, tmp_path: Path, refused: Refused
) -> None:
    (tmp_path / "summary.json").touch()
    told = f"{tmp_path / 'summary.json'} is not a summary of detect_bag: move it, or choose another --output."
    assert told in refused(main, drives, "--output", tmp_path, *SET_MODEL)


def test_another_calibration_makes_other_results_in_int8_only(tmp_path: Path) -> None:
    embedded = Path(plan_for(tmp_path).settings.weights)
    weights = Path(shutil.copy(embedded, tmp_path))
    calibration = path_beside(weights)

    def digest(precision: str) -> str:
        plan = plan_for(tmp_path, weights=str(weights), precision=precision, runtime="openvino")
        return plan.settings_sha256

    found = [(digest("int8"), digest("auto"))]
    for content in (path_beside(embedded).read_bytes(), b"another"):
        calibration.write_bytes(content)
        found.append((digest("int8"), digest("auto")))
    in_int8, in_fp32 = map(set, zip(*found, strict=True))
    assert (len(in_int8), len(in_fp32)) == (3, 1)


def test_a_recording_that_grows_while_it_is_read_fails(drives: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(drives / "east", tmp_path / "east"))
    plan = plan_for(tmp_path / "found")
    row = result_of(copy, plan, lambda _: (copy / "more.mcap").touch())
    assert (row.state, "it changed while it was read" in row.reason) == ("failed", True)
    assert list(plan.output.iterdir()) == []


def test_images_that_cannot_be_read_are_counted_with_the_first_problem(tmp_path: Path) -> None:
    odd = [raw(0), raw(1, encoding="32FC1"), raw(2, encoding="32FC1")]
    source = record(tmp_path / "odd", odd)
    result = result_of(source, plan_for(tmp_path / "found"))
    assert (result.images, result.detected, result.rejected) == (3, 1, 2)
    assert result.first_problem.startswith("1700000000.540000007: rejected: Encoding '32FC1'")


def test_a_lost_gpu_or_a_full_disk_is_no_fault_of_a_recording(drives: Path, tmp_path: Path) -> None:
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
    assert isinstance(refused, DetectingError)
    assert "No space left" in str(refused)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("name", "suffix", "file"),
    [
        pytest.param("film.avi", ".csv", "detections.csv", id="video"),
        pytest.param("film.avi", "", "detections.jsonl", id="video without suffix"),
        pytest.param("east", ".yolo", "detections.yolo", id="recording"),
        pytest.param("east", "", "east.mcap", id="recording without suffix"),
    ],
)
def test_a_result_has_the_format_of_the_folder_and_is_not_made_again(
    name: str, suffix: str, file: str, drives: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source, output = SourceRecording(Path(name).stem, drives / name), tmp_path / f"found{suffix}"
    assert result_of(source.path, plan_for(output, suffix=suffix, crops=True)).state == "done"
    folder = output / source.name
    assert {one.name for one in folder.iterdir()} - {"metadata.yaml"} == {file, "crops", RECORD_NAME}
    inode = folder.stat().st_ino
    words = [str(source.path), "--output", str(output), "--jobs", "1", "--crops", *SET_MODEL]
    assert main(words) == 0
    assert capsys.readouterr().err.startswith("recordings  1: 0 done, 1 skipped, 0 failed\n")
    assert folder.stat().st_ino == inode
    row = rows(output)[source.name]
    assert row["state"] == "skipped"
    assert len(list((folder / "crops").rglob("*.jpg"))) == sum(row["detections"].values()) > 0


def test_an_export_of_another_size_than_the_default_is_used_as_in_a_single_run(
    drives: Path, tmp_path: Path
) -> None:
    (tmp_path / "best.onnx").write_bytes(small_export())
    settings = validated({"weights": str(tmp_path / "best.onnx"), "device": "cpu"})
    plan = plan_of(settings, tmp_path / "found", Export(None, ".jsonl"))
    assert result_of(drives / "east", plan.chosen("onnxruntime", "fp32")).state == "done"


def test_each_format_with_or_without_crops_is_another_result(tmp_path: Path) -> None:
    formats = ["", *FORMATS]
    plans = [plan_for(tmp_path, suffix=one, crops=crops) for one in formats for crops in (False, True)]
    assert len({plan.settings_sha256 for plan in plans}) == 2 * len(formats)


@pytest.fixture
def source(tmp_path: Path) -> SourceRecording:
    (tmp_path / "drive").mkdir()
    (tmp_path / "drive" / "drive.mcap").write_bytes(b"images")
    return SourceRecording("drive", tmp_path / "drive")


@pytest.fixture
def result(source: SourceRecording, tmp_path: Path) -> Path:
    """A finished result."""
    folder, plan = tmp_path / "found" / "drive", plan_for(tmp_path / "found")
    folder.mkdir(parents=True)
    (folder / "drive.mcap").write_bytes(b"detections")
    made_from = origin(source.path, plan)
    row = RecordingResult(recording="drive", path="/before", state="done", images=3, made_from=made_from)
    (folder / RECORD_NAME).write_text(row.model_dump_json())
    return folder


@pytest.mark.parametrize(
    ("change", "settings", "is_finished"),
    [
        pytest.param(lambda *_: None, {}, True, id="nothing"),
        pytest.param(lambda source, _: (source / "notes.txt").touch(), {}, True, id="notes beside it"),
        pytest.param(lambda source, _: (source / "drive_1.mcap").touch(), {}, False, id="another file"),
        pytest.param(lambda source, _: (source / "drive.mcap").unlink(), {}, False, id="file missing"),
        pytest.param(lambda source, _: os.utime(source / "drive.mcap", ns=(1, 1)), {}, False, id="time"),
        pytest.param(lambda _, result: (result / RECORD_NAME).unlink(), {}, False, id="no record"),
        pytest.param(lambda *_: None, {"iou_threshold": 0.4}, False, id="setting"),
    ],
)
def test_what_has_changed_is_not_finished(
    change: Callable[[Path, Path], object],
    settings: dict[str, Any],
    is_finished: bool,
    source: SourceRecording,
    result: Path,
) -> None:
    change(source.path, result)
    row = finished_before(source, plan_for(result.parent, **settings))
    assert (row is not None) == is_finished
    assert row is None or (row.state, row.path, row.images) == ("skipped", str(source.path), 3)


def test_a_recording_that_was_renamed_with_its_result_has_the_new_name(
    source: SourceRecording, result: Path
) -> None:
    renamed = SourceRecording("monday", source.path.rename(source.path.with_name("monday")))
    result.rename(result.with_name("monday"))
    row = finished_before(renamed, plan_for(result.parent))
    assert row is not None
    assert row.recording == "monday"


def test_the_place_of_the_weights_makes_no_difference(
    source: SourceRecording, result: Path, tmp_path: Path
) -> None:
    moved = Path(shutil.copy(plan_for(result.parent).settings.weights, tmp_path / "moved.safetensors"))
    assert finished_before(source, plan_for(result.parent, weights=str(moved))) is not None


def test_other_weights_make_another_result(source: SourceRecording, tmp_path: Path) -> None:
    plan = plan_for(tmp_path)
    other = replace(plan, settings=plan.settings.model_copy(update={"weights_sha256": "0" * 64}))
    assert origin(source.path, other) != origin(source.path, plan)


@pytest.mark.parametrize("content", [b"", b"\xff\xfe", b"{}"], ids=["empty", "no text", "no record"])
def test_a_damaged_record_counts_as_none(content: bytes, source: SourceRecording, result: Path) -> None:
    (result / RECORD_NAME).write_bytes(content)
    assert finished_before(source, plan_for(result.parent)) is None
