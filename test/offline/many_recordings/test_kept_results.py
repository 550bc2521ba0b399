"""`detect_bag` over many recordings: it keeps finished results and the files of others."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from support.detected_offline import SET_MODEL
from support.many_recordings import Notes, plan_for, record_drives, result_of

from yolov5_lifecycle.offline.detect_bag import main
from yolov5_lifecycle.offline.many_recordings.supervisor import detect_recordings
from yolov5_lifecycle.offline.many_recordings.workers import Worker
from yolov5_lifecycle.offline.recordings import SourceRecording, recordings_of
from yolov5_lifecycle.quantization.calibration_file import path_beside


@pytest.fixture(scope="module")
def drives(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record_drives(tmp_path_factory.mktemp("recorded") / "drives", {"east": 2, "west": 2})


def test_a_result_of_somebody_else_is_not_replaced(drives: Path, tmp_path: Path) -> None:
    kept = tmp_path / "east" / "notes.txt"
    kept.parent.mkdir()
    kept.write_text("mine")
    result = result_of(SourceRecording("east", drives / "east"), plan_for(tmp_path))
    assert result.reason == f"{kept.parent} exists and has no record of detect_bag: move or remove it."
    assert kept.read_text() == "mine"


def test_what_somebody_adds_to_a_result_is_not_lost(drives: Path, tmp_path: Path) -> None:
    source = SourceRecording("east", drives / "east")
    assert result_of(source, plan_for(tmp_path)).state == "done"
    (tmp_path / "east" / "notes.txt").write_text("mine")
    assert result_of(source, plan_for(tmp_path)).state == "skipped"
    result = result_of(source, plan_for(tmp_path, classes=["star"]))
    east = tmp_path / "east"
    assert result.reason == f"{east} is not replaced because it also contains notes.txt: move that elsewhere."
    assert (tmp_path / "east" / "notes.txt").read_text() == "mine"


def text(path: Path) -> None:
    path.write_text("mine")


def link(path: Path) -> None:
    path.symlink_to("elsewhere")


@pytest.mark.parametrize("make", [text, os.mkfifo, link, Path.mkdir], ids=["file", "pipe", "link", "folder"])
@pytest.mark.parametrize("name", ["summary.json", "summary.parquet"])
def test_a_summary_of_somebody_else_is_not_replaced(
    name: str,
    make: Callable[[Path], None],
    drives: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    make(tmp_path / name)
    assert main([str(drives), "--output", str(tmp_path), *SET_MODEL]) == 1
    told = f"{tmp_path / name} is not a summary of detect_bag: move it, or choose another --output."
    assert told in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == [name]


def test_a_folder_of_results_whose_name_is_no_text_is_refused(
    drives: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([str(drives), "--output", str(tmp_path / "found\udcff"), *SET_MODEL]) == 1
    assert "the name of the folder of results must be UTF-8" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_an_empty_folder_of_the_user_stays(drives: Path, tmp_path: Path) -> None:
    def no_workers(_: int) -> list[Worker]:
        raise OSError("no process can be started")

    sources = recordings_of([drives], tmp_path)
    with pytest.raises(OSError, match="no process can be started"):
        detect_recordings(sources, plan_for(tmp_path), new_workers=no_workers, terminal=Notes())
    assert tmp_path.is_dir()


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
