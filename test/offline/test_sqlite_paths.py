"""SQLite recordings at paths that mean something else in a URI, in which rosbags puts them."""

from __future__ import annotations

import shutil
import sqlite3
from contextlib import closing
from pathlib import Path

import pytest
from rosbags.rosbag2 import CompressionMode, StoragePlugin
from support.detected_offline import SET_MODEL, run
from support.many_recordings import messages
from support.recorded_scene import raw, record

from yolov5_lifecycle.offline.detect_bag import main
from yolov5_lifecycle.offline.recording import open_recording
from yolov5_lifecycle.offline.sqlite_path import UriPath

MCAP, SQLITE = StoragePlugin.MCAP, StoragePlugin.SQLITE3
ODD = ["run#1", "par#x/out", "run%41", "par?mode=ro/out", "50% done", "ein fürchterlicher Name"]


@pytest.fixture
def drive(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A recording in SQLite in the current folder."""
    monkeypatch.chdir(tmp_path)
    return record(Path("drive"), [raw(0)], storage=SQLITE)


def stored_topics(recording: Path) -> set[str]:
    """The topics in the database of a result, read without rosbags."""
    (file,) = recording.glob("*.db3")
    plain = shutil.copy(file, "plain.db3")
    with closing(sqlite3.connect(plain)) as database:
        return {name for (name,) in database.execute("SELECT name FROM topics")}


@pytest.mark.parametrize("path", [*ODD, "//server/drive", "run\udcff", "a&b=c+d"])
def test_a_path_is_the_same_one_in_a_uri(path: str, tmp_path: Path) -> None:
    file = UriPath(f"{tmp_path}//{path}")
    file.parent.mkdir(parents=True, exist_ok=True)
    sqlite3.connect(f"file:{file}", uri=True).execute("CREATE TABLE messages (id)").connection.close()
    assert Path(str(file)).is_file()


def test_a_path_with_two_slashes_in_front_is_no_host() -> None:
    assert f"file:{UriPath('//server/drive')}" == "file:%2F%2Fserver%2Fdrive"


@pytest.mark.long
@pytest.mark.parametrize("is_absolute", [False, True], ids=["relative", "absolute"])
@pytest.mark.parametrize("output", ODD)
def test_a_result_is_written_to_any_path(output: str, is_absolute: bool, drive: Path) -> None:
    target = Path(output).absolute() if is_absolute else Path(output)
    target.parent.mkdir(exist_ok=True)
    before = set(Path().rglob("*"))
    assert run([str(drive), "--output", str(target), *SET_MODEL]) == 0
    assert set(Path().rglob("*")) - before == {
        *(Path(output), Path(output) / "metadata.yaml"),
        Path(output) / f"{target.name}.db3",
    }
    assert "/yolov5/detections" in stored_topics(target)


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


@pytest.mark.parametrize("source", ["src#1", "src#1/drive.db3", "drive#1.db3", "drive?mode=memory.db3"])
def test_a_source_is_read_from_any_path(source: str, drive: Path) -> None:
    if "src" in source:
        drive.rename("src#1")
    else:
        (drive / "drive.db3").rename(source)
    assert run([source, "--output", "found", *SET_MODEL]) == 0
    assert messages(Path("found"))


def test_a_recording_cannot_name_a_database_outside_of_its_folder(drive: Path) -> None:
    Path("secret.db3").write_bytes(b"not for you")
    (drive / "drive.db3").rename(drive / "%2e%2e%2fsecret.db3")
    metadata = drive / "metadata.yaml"
    metadata.write_text(metadata.read_text().replace("drive.db3", "'%2e%2e%2fsecret.db3'"))
    with open_recording(drive) as recording:
        assert recording.image_topic().count == 1


def test_a_packed_recording_may_have_any_name(tmp_path: Path) -> None:
    record(tmp_path / "drive", [raw(0)], storage=SQLITE, compression=CompressionMode.FILE)
    metadata = tmp_path / "drive" / "metadata.yaml"
    metadata.write_text(metadata.read_text().replace("drive.db3", "drive#1.db3"))
    (tmp_path / "drive" / "drive.db3.zstd").rename(tmp_path / "drive" / "drive#1.db3.zstd")
    with open_recording(tmp_path / "drive") as recording:
        assert recording.image_topic().count == 1


@pytest.mark.parametrize("storage", [MCAP, SQLITE], ids=["MCAP", "SQLite"])
def test_a_name_that_metadata_cannot_hold_is_refused_at_once(
    storage: StoragePlugin, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source = record(tmp_path / "drive", [raw(0)], storage=storage)
    assert run([str(source), "--output", str(tmp_path / "run\udcff"), *SET_MODEL]) == 1
    assert "choose another --output" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == [source]


@pytest.mark.long
def test_the_results_of_many_recordings_may_be_anywhere(drive: Path) -> None:
    drive.rename("drive#1")
    record(Path("other#1"), [raw(0)], storage=MCAP)
    assert main(["drive#1", "other#1", "--output", "found#1", "--jobs", "1", *SET_MODEL]) == 0
    assert "/yolov5/detections" in stored_topics(Path("found#1/drive#1"))
    assert messages(Path("found#1/other#1"))
