"""Which recordings the sources of a command stand for, and which of them have a result already."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from support.many_recordings import plan_for
from support.special_cache_files import SPECIAL_CACHE_FILES

from yolov5_lifecycle.offline.many_recordings.results import (
    RECORD_NAME,
    Record,
    RecordingResult,
    file_stamps,
    finished_before,
    read_record,
)
from yolov5_lifecycle.offline.recordings import SourceRecording, are_many, recordings_of
from yolov5_lifecycle.quantization.calibration_file import path_beside
from yolov5_lifecycle.sources.frames import SourceError


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Two days of recordings, single files, images and results."""
    files = (
        *("monday/a/a_0.mcap", "monday/a/metadata.yaml", "monday/b/b_0.db3", "monday/b/metadata.yaml"),
        *("monday/notes.txt", "monday/empty/notes.txt", "monday/.hidden/h.mcap"),
        *("tuesday/a/a_0.mcap", "tuesday/a/metadata.yaml", "tuesday/c/c_0.mcap.zstd"),
        *("files/d.mcap", "files/e_0.mcap.zstd", "files/e_1.db3", "lost/one.mcap"),
        *("shots/0.png", "shots/raw/r.mcap", "found/a/a.mcap", "found/a/metadata.yaml"),
        *("summary.json/s.mcap", "dots/..mcap", "dots/a.mcap"),
        *("films/f.mp4", "films/g.AVI", "films/notes.txt", "one film/h.mkv"),
        *("mixed/m.mov", "mixed/bag/b.mcap", "pictures/p.jpg", "pictures/p.mp4"),
        *("checked/a.mcap", "checked/a.mcap.md5", "checked/b.db3", "checked/b.db3.part"),
    )
    for file in files:
        (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / file).touch()
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    ("sources", "names"),
    [
        pytest.param(["monday"], ["a", "b"], id="folder of recordings"),
        pytest.param(["monday/*"], ["a", "b"], id="pattern"),
        pytest.param(["*day/[bc]"], ["b", "c"], id="pattern over folders"),
        pytest.param(["monday/a", "tuesday/c"], ["a", "c"], id="paths"),
        pytest.param(["monday/a", "monday"], ["a", "b"], id="one twice"),
        pytest.param(["monday/**"], ["a", "b"], id="recordings and their files"),
        pytest.param(["files"], ["d", "e_0", "e_1"], id="folder of files"),
        pytest.param(["checked"], ["a", "b"], id="files and their checksums"),
        pytest.param(["checked/*"], ["a", "b"], id="pattern of files and their checksums"),
        pytest.param(["files/*.mcap", "files/e_1.db3"], ["d", "e_1"], id="files"),
        pytest.param(["mon*"], ["a", "b"], id="pattern of a folder of them"),
        pytest.param(["[mf]o*"], ["a", "b"], id="results are no sources"),
        pytest.param(["films"], ["f", "g"], id="folder of videos"),
        pytest.param(["films/*"], ["f", "g"], id="pattern of videos"),
        pytest.param(["one film"], ["h"], id="folder of one video"),
        pytest.param(["mixed"], ["bag", "m"], id="folder of recordings and videos"),
        pytest.param(
            ["films", "monday/a", "one film/h.mkv"], ["f", "g", "a", "h"], id="videos and recordings"
        ),
        pytest.param(["pictures/*"], ["p"], id="pattern of pictures and videos"),
    ],
)
def test_sources_stand_for_recordings(sources: list[str], names: list[str], home: Path) -> None:
    found = recordings_of(map(Path, sources), home / "found")
    assert [recording.name for recording in found] == names
    assert all(recording.path.is_absolute() for recording in found)


@pytest.mark.parametrize(
    ("sources", "told"),
    [
        pytest.param(["sunday"], "sunday: file or folder not found", id="missing"),
        pytest.param(["sun*"], r"sun\*: file or folder not found", id="pattern of nothing"),
        pytest.param(
            ["shots/*.png"], r"png: expected ros2 bag recordings .* or videos", id="pattern of images"
        ),
        pytest.param(
            ["monday/notes.txt", "files"], "notes.txt: expected ros2 bag recordings", id="no recording"
        ),
        pytest.param(["found"], "found: all its recordings are in the folder of results", id="results"),
        pytest.param(["dots/..mcap"], "dots/..mcap: its result cannot have that name", id="dots"),
        pytest.param(["*day"], r"1 name\(s\) belong to several .*\n.*monday/a, .*tuesday/a", id="same names"),
        pytest.param(["summary.json"], "its result cannot have that name", id="reserved name"),
    ],
)
def test_sources_that_stand_for_none_are_refused(sources: list[str], told: str, home: Path) -> None:
    with pytest.raises(SourceError, match=told):
        recordings_of(map(Path, sources), home / "found")


def test_a_name_that_is_no_text_is_refused(tmp_path: Path) -> None:
    odd = tmp_path / "drive\udcff"
    odd.mkdir()
    (odd / "a.mcap").touch()
    with pytest.raises(SourceError, match="its result cannot have that name"):
        recordings_of([odd], tmp_path / "found")


@pytest.mark.parametrize(
    ("sources", "many"),
    [
        (["monday/a"], False),
        (["files/d.mcap"], False),
        (["lost"], False),
        (["films/f.mp4"], False),
        (["pictures"], False),
        (["films"], True),
        (["one film"], True),
        (["films/*.mp4"], True),
        (["mixed"], True),
        (["shots"], False),
        (["nothing"], False),
        (["sun*"], False),
        (["monday"], True),
        (["files"], True),
        (["monday/a*"], True),
        (["monday/a", "tuesday/a"], True),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_one_recording_is_one_unless_it_is_named_as_many(sources: list[str], many: bool, home: Path) -> None:
    assert are_many(list(map(Path, sources))) == many


def test_a_file_whose_name_has_wildcards_is_no_pattern(tmp_path: Path) -> None:
    odd = tmp_path / "drive[1].mcap"
    odd.touch()
    assert not are_many([odd])
    assert recordings_of([odd], tmp_path / "found") == [SourceRecording("drive[1]", odd)]


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
    Record(
        weights_sha256=plan.settings.weights_sha256,
        settings_sha256=plan.settings_sha256,
        recording_sha256="0" * 64,
        recording_files=file_stamps(source.path),
        result_bytes={"drive.mcap": 10},
        result=RecordingResult(recording="drive", path="/before", state="done", images=3),
    ).write(folder)
    return folder


def test_a_finished_result_is_found(source: SourceRecording, result: Path) -> None:
    row = finished_before(source, plan_for(result.parent))
    assert row is not None
    assert (row.state, row.path, row.images) == ("skipped", str(source.path), 3)


@pytest.mark.parametrize(
    ("change", "settings"),
    [
        pytest.param(lambda source, _: (source / "drive.mcap").write_bytes(b"others"), {}, id="content"),
        pytest.param(lambda source, _: (source / "drive_1.mcap").touch(), {}, id="another file"),
        pytest.param(lambda source, _: (source / "drive.mcap").unlink(), {}, id="file missing"),
        pytest.param(lambda _, result: (result / "drive.mcap").write_bytes(b""), {}, id="result cut off"),
        pytest.param(lambda _, result: (result / RECORD_NAME).unlink(), {}, id="no record"),
        pytest.param(lambda *_: None, {"iou_threshold": 0.4}, id="setting"),
    ],
)
def test_what_has_changed_is_not_finished(
    change: Callable[[Path, Path], object],
    settings: dict[str, Any],
    source: SourceRecording,
    result: Path,
) -> None:
    change(source.path, result)
    assert finished_before(source, plan_for(result.parent, **settings)) is None


def test_the_place_of_the_weights_makes_no_difference(
    source: SourceRecording, result: Path, tmp_path: Path
) -> None:
    weights = Path(plan_for(result.parent).settings.weights)
    moved = tmp_path / "moved.safetensors"
    moved.write_bytes(weights.read_bytes())
    path_beside(moved).write_bytes(path_beside(weights).read_bytes())
    assert finished_before(source, plan_for(result.parent, weights=str(moved))) is not None


def test_notes_beside_the_files_of_a_recording_make_no_difference(
    source: SourceRecording, result: Path
) -> None:
    (source.path / "notes.txt").touch()
    assert finished_before(source, plan_for(result.parent)) is not None


@pytest.mark.parametrize(
    "content",
    [
        pytest.param(lambda _: b"", id="empty"),
        pytest.param(lambda _: b"[]", id="list"),
        pytest.param(lambda _: b"{}", id="nothing in it"),
        pytest.param(lambda _: b"\xff\xfe", id="no text"),
        pytest.param(lambda _: b"[" * 100_000, id="deep"),
        pytest.param(lambda record: record[:-9], id="cut off"),
        pytest.param(lambda record: record.replace(b'"drive"', b'"other"'), id="another recording"),
        pytest.param(lambda record: record.replace(b": 3", b": -3"), id="negative count"),
        pytest.param(lambda record: record + b" " * (16 << 20), id="too large"),
    ],
)
def test_a_damaged_record_counts_as_none(content: Callable[[bytes], bytes], result: Path) -> None:
    record = result / RECORD_NAME
    assert read_record(result) is not None
    record.write_bytes(content(record.read_bytes()))
    assert read_record(result) is None


@pytest.mark.parametrize("make", SPECIAL_CACHE_FILES.values(), ids=SPECIAL_CACHE_FILES)
def test_a_record_that_is_no_small_file_counts_as_none(
    make: Callable[[Path], object], tmp_path: Path
) -> None:
    make(tmp_path / RECORD_NAME)
    assert read_record(tmp_path) is None
