"""SQLite recordings whose paths rosbags would open as others: refused, and nothing is written elsewhere."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from rosbags.rosbag2 import CompressionMode, StoragePlugin
from support.detected_offline import SET_MODEL, run
from support.many_recordings import messages
from support.recorded_scene import raw, record

from yolov5_lifecycle.offline.detect_bag import main
from yolov5_lifecycle.offline.recording import RecordingError, open_recording
from yolov5_lifecycle.offline.recordings import sqlite_problem

MCAP, SQLITE = StoragePlugin.MCAP, StoragePlugin.SQLITE3


@pytest.fixture
def drive(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A recording in SQLite in the current folder."""
    monkeypatch.chdir(tmp_path)
    return record(Path("drive"), [raw(0)], storage=SQLITE)


@pytest.mark.parametrize(
    ("path", "found"),
    [
        ("run#1", "'#'"),
        ("what?/out", "'?'"),
        ("run%41", "'%41'"),
        ("/data/%2e%2e", "'%2e'"),
        ("//server/drive", "'//'"),
        ("run\udcff", r"'\udcff'"),
    ],
)
def test_a_path_that_changes_in_a_uri_is_a_problem(path: str, found: str) -> None:
    assert f"{found} in its path" in sqlite_problem(Path(path))


@pytest.mark.parametrize("path", ["run", "/data/50% done", "ein fürchterlicher Name", "a&b=c+d", "///run"])
def test_any_other_path_is_none(path: str) -> None:
    assert sqlite_problem(Path(path)) == ""


@pytest.mark.parametrize("output", ["run#1", "par#x/out", "run%41", "par?mode=ro/out"])
def test_an_output_that_sqlite_would_write_elsewhere_is_refused(
    output: str, drive: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    Path(output).parent.mkdir(exist_ok=True)
    before = sorted(Path().rglob("*"))
    assert run([str(drive), "--output", output, *SET_MODEL]) == 1
    told = capsys.readouterr().err
    assert told.startswith(f"detect_bag: {Path(output).name}: an SQLite file cannot be opened with '")
    assert "choose another --output" in told
    assert sorted(Path().rglob("*")) == before


def test_mcap_is_written_to_any_path(tmp_path: Path) -> None:
    source = record(tmp_path / "drive#1", [raw(0)], storage=MCAP)
    assert run([str(source), "--output", str(tmp_path / "run#1%41"), *SET_MODEL]) == 0
    assert messages(tmp_path / "run#1%41")


def test_a_folder_above_the_current_one_may_have_any_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "disk#1").mkdir()
    monkeypatch.chdir(tmp_path / "disk#1")
    record(Path("drive"), [raw(0)], storage=SQLITE)
    assert run(["drive", "--output", "found", *SET_MODEL]) == 0
    assert messages(Path("found"))


@pytest.mark.parametrize("source", ["src#1", "src#1/drive.db3", "drive#1.db3"])
def test_a_source_that_sqlite_would_look_for_elsewhere_is_refused(
    source: str, drive: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    if "src" in source:
        drive.rename("src#1")
    else:
        (drive / "drive.db3").rename(source)
    assert run([source, "--output", "found", *SET_MODEL]) == 1
    told = capsys.readouterr().err
    assert "'#' in its path" in told
    assert "rename" in told
    assert "reindex" not in told
    assert not Path("found").exists()


def test_a_recording_cannot_name_a_database_outside_of_its_folder(drive: Path) -> None:
    shutil.copy(drive / "drive.db3", "secret.mcap")
    (drive / "drive.db3").rename(drive / "%2e%2e%2fsecret.mcap")
    metadata = drive / "metadata.yaml"
    metadata.write_text(metadata.read_text().replace("drive.db3", "'%2e%2e%2fsecret.mcap'"))
    with pytest.raises(RecordingError, match="rename"), open_recording(drive):
        pass


def test_a_packed_recording_of_such_a_name_is_refused(tmp_path: Path) -> None:
    record(tmp_path / "drive", [raw(0)], storage=SQLITE, compression=CompressionMode.FILE)
    metadata = tmp_path / "drive" / "metadata.yaml"
    metadata.write_text(metadata.read_text().replace("drive.db3", "drive#1.db3"))
    (tmp_path / "drive" / "drive.db3.zstd").rename(tmp_path / "drive" / "drive#1.db3.zstd")
    with pytest.raises(RecordingError, match="rename"), open_recording(tmp_path / "drive"):
        pass


@pytest.mark.parametrize("storage", [MCAP, SQLITE], ids=["MCAP", "SQLite"])
def test_a_name_that_metadata_cannot_hold_is_refused_at_once(
    storage: StoragePlugin, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source = record(tmp_path / "drive", [raw(0)], storage=storage)
    assert run([str(source), "--output", str(tmp_path / "run\udcff"), *SET_MODEL]) == 1
    assert "choose another --output" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == [source]


def test_a_folder_of_results_that_sqlite_cannot_use_ends_the_command_before_it_begins(
    drive: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    record(Path("other"), [raw(0)], storage=MCAP)
    words = ["drive", "other", "--output", "found#1", *SET_MODEL]
    assert main(words) == 1
    assert "'#' in its path" in capsys.readouterr().err
    assert sorted(Path().iterdir()) == [Path("drive"), Path("other")]


def test_a_recording_that_sqlite_cannot_use_is_set_aside_alone(
    drive: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    drive.rename("drive#1")
    record(Path("other#1"), [raw(0)], storage=MCAP)
    assert main(["drive#1", "other#1", "--output", "found", "--jobs", "1", *SET_MODEL]) == 3
    assert "'#' in its path" in capsys.readouterr().err
    assert messages(Path("found/other#1"))
    assert not Path("found/drive#1").exists()
