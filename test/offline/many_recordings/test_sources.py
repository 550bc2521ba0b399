"""Which recordings and videos the sources of a command stand for."""

from __future__ import annotations

from pathlib import Path

import pytest
from support.refusals import Refused

from yolov5_lifecycle.offline.detect_bag import main
from yolov5_lifecycle.offline.recordings import are_many, recordings_of
from yolov5_lifecycle.sources.frames import SourceError


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Two days of recordings, single files, images and results."""
    files = (
        *("monday/a/a_0.mcap", "monday/a/metadata.yaml", "monday/b/b_0.db3", "monday/b/metadata.yaml"),
        *("monday/notes.txt", "monday/empty/notes.txt", "monday/.hidden/h.mcap"),
        *("tuesday/a/a_0.mcap", "tuesday/a/metadata.yaml", "tuesday/c/c_0.mcap.zstd"),
        *("files/d.mcap", "files/d.mcap.md5", "files/e_0.mcap.zstd", "files/e_1.db3", "lost/one.mcap"),
        *("shots/0.png", "shots/raw/r.mcap", "found/a/a.mcap", "found/a/metadata.yaml"),
        *("summary.json/s.mcap", "dots/..mcap", "dots/a.mcap"),
        *("films/f.mp4", "films/g.AVI", "films/notes.txt", "one film/h.mkv"),
        *("mixed/m.mov", "mixed/bag/b.mcap", "pictures/p.jpg", "pictures/p.mp4"),
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
        pytest.param(["monday/a", "monday"], ["a", "b"], id="one twice"),
        pytest.param(["files"], ["d", "e_0", "e_1"], id="folder of files and checksums"),
        pytest.param(["pictures/../films"], ["f", "g"], id="path over another folder"),
        pytest.param(["mixed", "monday/a", "one film/h.mkv"], ["bag", "m", "a", "h"], id="all kinds"),
    ],
)
def test_sources_stand_for_recordings(sources: list[str], names: list[str], home: Path) -> None:
    found = recordings_of(map(Path, sources), home / "found")
    assert [recording.name for recording in found] == names
    assert all(recording.path.is_absolute() for recording in found)


@pytest.mark.parametrize(
    ("sources", "told"),
    [
        pytest.param(
            ["monday/notes.txt", "files"], "notes.txt: expected ros2 bag recordings", id="no recording"
        ),
        pytest.param(["monday", "shots/0.png"], "A folder of images is .* give it alone", id="image"),
        pytest.param(["found"], "found: it is in the folder of results", id="results"),
        pytest.param(["dots/..mcap"], "dots/..mcap: its result cannot have that name", id="dots"),
        pytest.param(
            ["monday", "tuesday"],
            r"monday/a and .*tuesday/a: their results would have the same name",
            id="same names",
        ),
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
        (["lost"], False),
        (["pictures"], False),
        (["one film"], True),
        (["mixed"], True),
        (["shots"], False),
        (["monday"], True),
        (["monday/a", "tuesday/a"], True),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_one_recording_is_one_unless_it_is_named_as_many(sources: list[str], many: bool, home: Path) -> None:
    assert are_many(list(map(Path, sources))) == many


@pytest.mark.usefixtures("home")
def test_a_pattern_in_quotes_is_told_to_go_without(refused: Refused) -> None:
    told = refused(main, "monday/*", "--output", "new")
    assert "monday/*: file or folder not found; leave out quotes around a pattern" in told
