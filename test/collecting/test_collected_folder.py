"""The folder of kept images: readable at every moment, within its quota, of one process; its list."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from support.candidates import CLASS_NAMES, RECORD, add, candidate, frames_of, images_of, keep, look_of
from support.started import started

from yolov5_lifecycle.atomic_file import FOLDER_PREFIX
from yolov5_lifecycle.collecting import collected_files
from yolov5_lifecycle.collecting.candidate import Detail, Trigger
from yolov5_lifecycle.collecting.collected_files import (
    FRAMES,
    IMAGES,
    LABELS,
    CollectedFrame,
    CollectingError,
    embedding_text,
    file_of,
    recorded_images,
)
from yolov5_lifecycle.collecting.collected_folder import CollectedFolder, Quota, RecordingSession
from yolov5_lifecycle.evaluation.ground_truth import Problems
from yolov5_lifecycle.evaluation.yolo_folder import read_yolo_folder

STRANGE_NAME = 'no "bird": #1\\ \U0001f600 \u06af\u0631\u0628\u0647\u200c\u0647\u0627'
LARGE = Quota(max_bytes=1 << 30, max_frames=1000, min_free_bytes=0)
ROOM = 3


def files(folder: Path, pattern: str = "*.jpg") -> list[str]:
    return sorted(os.fspath(path.relative_to(folder)) for path in folder.rglob(pattern))


def check(folder: Path, names: tuple[str, ...] = CLASS_NAMES) -> int:
    """Check that the images, the labels and the list agree; return their number."""
    kept = [image.path for image in images_of(folder)]
    assert kept == recorded_images(folder)
    assert kept == files(folder)
    assert [file_of(image, LABELS) for image in kept] == files(folder, "*.txt")
    assert [*folder.rglob(".*")] == []
    told: list[str] = []
    problems = Problems(told.append)
    data = read_yolo_folder(folder, problems)
    assert (data.class_names, told) == (names, [])
    assert len(data.images) == len(kept)
    return len(kept)


def collected(path: Path, count: int) -> CollectedFolder:
    """The folder at `path`, in which another process has kept so many frames."""
    with closing(CollectedFolder(path, LARGE)) as folder:
        for seed in range(count):
            keep(folder, seed)
    return folder


def test_a_kept_frame_is_an_image_its_labels_and_a_line(tmp_path: Path) -> None:
    folder = CollectedFolder(tmp_path / "new", LARGE, session=RecordingSession())
    assert keep(folder)
    (frame,) = frames_of(tmp_path / "new")
    assert frame.image == f"images/{folder.session.name}/000001.jpg"
    assert (frame.frame_id, frame.sec, frame.nanosec, frame.size_wh) == ("optical_frame", 12, 34, (64, 48))
    assert [(each.class_name, each.box_xyxy) for each in frame.objects] == [("cat", (10, 10, 30, 40))]
    assert frame.weights_sha256 == "ab" * 32
    parts = (file_of(frame.image, kind) for kind in (IMAGES, LABELS, FRAMES))
    written = sum((tmp_path / "new" / path).stat().st_size for path in parts)
    assert folder.size_bytes == written
    folder.close()
    assert check(tmp_path / "new") == 1


def test_the_least_valuable_frame_goes_first_and_of_equals_the_oldest(tmp_path: Path) -> None:
    folder = CollectedFolder(tmp_path, replace(LARGE, max_frames=ROOM))
    kept = [keep(folder, seed, value=value) for seed, value in enumerate([2.0, 1.0, 1.0, 2.0, 0.5, 1.0])]
    assert kept == [True, True, True, True, False, True]
    folder.close()
    assert check(tmp_path) == ROOM
    assert [frame.value for frame in frames_of(tmp_path)] == [2.0, 2.0, 1.0]
    assert files(tmp_path) == [f"images/{folder.session.name}/{number:06d}.jpg" for number in (1, 4, 6)]
    CollectedFolder(tmp_path, replace(LARGE, max_frames=1)).close()  # a smaller one takes effect at once
    assert [frame.value for frame in frames_of(tmp_path)] == [2.0]


def test_the_folder_is_never_larger_than_its_quota(tmp_path: Path) -> None:
    folder = CollectedFolder(tmp_path, replace(LARGE, max_bytes=30_000))
    for seed in range(40):
        assert keep(folder, seed)
        kept = [path for path in tmp_path.rglob("*") if path.suffix in (".jpg", ".txt", ".json")]
        assert sum(path.stat().st_size for path in kept) == folder.size_bytes <= 30_000
    folder.close()
    assert check(tmp_path) > 2


def test_an_image_that_somebody_deletes_takes_no_room(tmp_path: Path) -> None:
    folder = CollectedFolder(tmp_path, replace(LARGE, max_frames=ROOM))
    for seed, value in enumerate([3.0, 1.0, 2.0]):
        assert keep(folder, seed, value=value)
    (tmp_path / files(tmp_path)[0]).unlink()
    assert keep(folder, 3, value=0.5)
    assert not keep(folder, 4, value=0.4)
    folder.close()
    assert check(tmp_path) == ROOM
    assert [frame.value for frame in frames_of(tmp_path)] == [1.0, 2.0, 0.5]


@pytest.mark.parametrize(
    "quota",
    [lambda _: replace(LARGE, max_frames=1), lambda size: replace(LARGE, max_bytes=3 * size // 2)],
    ids=["images", "bytes"],
)
def test_a_session_that_somebody_deletes_takes_no_room(quota: Callable[[int], Quota], tmp_path: Path) -> None:
    before = collected(tmp_path, 1)
    folder = CollectedFolder(tmp_path, quota(before.size_bytes))
    shutil.rmtree(tmp_path / IMAGES / before.session.name)
    assert keep(folder, 1, value=0.5)
    folder.close()
    assert check(tmp_path) == 1


def test_a_frame_that_is_larger_than_the_quota_removes_nothing(tmp_path: Path) -> None:
    small = CollectedFolder(tmp_path, replace(LARGE, max_bytes=collected(tmp_path, 1).size_bytes))
    large = candidate(1, received_jpeg=np.zeros(100_000, np.uint8), reasons={Trigger.REQUESTED: Detail("")})
    assert not add(small, large)
    small.close()
    assert check(tmp_path) == 1


def test_what_was_kept_before_is_known_again_and_a_process_goes_on_with_its_session(tmp_path: Path) -> None:
    first = collected(tmp_path, 1)
    again = CollectedFolder(tmp_path, LARGE)
    assert (len(again), again.size_bytes, again.class_names) == (1, first.size_bytes, CLASS_NAMES)
    assert again.descriptors.distance(look_of(0)) == pytest.approx(0, abs=1e-3)
    assert again.descriptors.distance(look_of(6)) > 0.5
    assert again.session.name != first.session.name
    again.close()
    other = CollectedFolder(tmp_path, LARGE, session=first.session)
    keep(other, 6)
    other.close()
    assert files(tmp_path) == [f"images/{first.session.name}/{number:06d}.jpg" for number in (1, 2)]


def test_models_with_other_classes_share_the_folder_by_their_names(tmp_path: Path) -> None:
    folder = CollectedFolder(tmp_path, LARGE)
    keep(folder, 0)
    keep(folder, 1, names=(STRANGE_NAME, "cat"))
    folder.close()
    names = ("cat", "dog", STRANGE_NAME)
    assert check(tmp_path, names) == 2
    with closing(CollectedFolder(tmp_path, LARGE)) as again:
        assert again.class_names == names
    ids = [path.read_text().split()[0] for path in sorted(tmp_path.rglob("*.txt"))]
    assert ids == ["0", "2"]  # class 0 of each model


def test_only_one_process_has_the_folder(tmp_path: Path) -> None:
    folder = CollectedFolder(tmp_path, LARGE)
    with pytest.raises(CollectingError, match="another process"):
        CollectedFolder(tmp_path, LARGE)
    folder.close()
    folder.close()
    CollectedFolder(tmp_path, LARGE).close()


def test_without_space_nothing_is_written(tmp_path: Path) -> None:
    folder = CollectedFolder(tmp_path, replace(LARGE, min_free_bytes=1 << 60))
    with pytest.raises(CollectingError, match="free on the disk"):
        keep(folder)
    assert files(tmp_path) == files(tmp_path, "*.txt") == []


def test_nothing_is_written_into_another_folder_of_the_same_name(tmp_path: Path) -> None:
    path = tmp_path / "stick"
    folder = CollectedFolder(path, replace(LARGE, max_frames=1))
    keep(folder, 0)
    keep(folder, 1)
    path.rename(tmp_path / "unplugged")
    with pytest.raises(CollectingError, match="unmounted"):
        keep(folder, 2)
    path.mkdir()
    for names in (CLASS_NAMES, ("other", "classes")):
        with pytest.raises(CollectingError, match="unmounted"):
            keep(folder, 2, names=names)
    folder.close()
    assert [*path.iterdir()] == []


def test_a_session_waits_for_its_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    mounted = [tmp_path / "stick"]
    monkeypatch.setattr("os.path.ismount", lambda path: path in mounted)
    session, path = RecordingSession(), tmp_path / "stick" / "collected"
    mounted[0].mkdir()
    CollectedFolder(path, LARGE, session=session).close()
    path.rename(tmp_path / "unplugged")
    disk = mounted.pop()
    with pytest.raises(CollectingError, match="unmounted"):
        CollectedFolder(path, LARGE, session=session)
    assert [*disk.iterdir()] == []
    mounted.append(disk)
    CollectedFolder(path, LARGE, session=session).close()


def test_a_folder_is_not_created_where_a_disk_is_missing(tmp_path: Path) -> None:
    with pytest.raises(CollectingError, match=rf"no folder {tmp_path}/media; mount"):
        CollectedFolder(tmp_path / "media" / "stick", LARGE)
    assert [*tmp_path.iterdir()] == []


@pytest.mark.parametrize("name", ["data.yaml", "images", "labels"])
def test_a_data_set_that_nobody_has_collected_stays_as_it_is(tmp_path: Path, name: str) -> None:
    (tmp_path / name).mkdir()
    with pytest.raises(CollectingError, match=f"has {name}, but no frames.*set collect_dir to a new"):
        CollectedFolder(tmp_path, LARGE)
    assert [path.name for path in tmp_path.iterdir()] == [name]


def test_a_frame_that_cannot_be_written_leaves_nothing(tmp_path: Path) -> None:
    folder = CollectedFolder(tmp_path, LARGE)
    keep(folder, 0)
    in_the_way = tmp_path / "labels" / folder.session.name / "000002.txt"
    in_the_way.mkdir()
    with pytest.raises(IsADirectoryError):
        keep(folder, 1)
    in_the_way.rmdir()
    assert keep(folder, 2)
    folder.close()
    assert check(tmp_path) == 2


@pytest.mark.parametrize("damage", ["missing", "broken"])
def test_without_the_names_of_its_classes_a_folder_is_refused(tmp_path: Path, damage: str) -> None:
    collected(tmp_path, 1)
    description = tmp_path / "data.yaml"
    description.unlink() if damage == "missing" else description.write_text("names: {{{")
    with pytest.raises(CollectingError, match=r"data\.yaml"):
        CollectedFolder(tmp_path, LARGE)
    assert len(files(tmp_path)) == 1


def test_what_a_killed_process_left_unfinished_is_removed(tmp_path: Path) -> None:
    session = tmp_path / IMAGES / collected(tmp_path, 1).session.name
    for parent in (tmp_path, session):
        left = parent / f"{FOLDER_PREFIX}killed"
        left.mkdir()
        (left / "unfinished").write_bytes(b"half")
    (tmp_path / LABELS / session.name / f"{FOLDER_PREFIX}killed-before-it-wrote").mkdir()
    CollectedFolder(tmp_path, LARGE).close()
    assert check(tmp_path) == 1


def test_what_somebody_else_put_there_stays(tmp_path: Path) -> None:
    CollectedFolder(tmp_path, LARGE).close()
    (tmp_path / "images" / "mine").mkdir(parents=True)
    (tmp_path / "images" / "mine" / "1.jpg").touch()
    (tmp_path / "notes.txt").write_text("mine")
    (tmp_path / "videos").mkdir()
    (tmp_path / "videos" / ".drive.mp4.part").touch()
    folder = CollectedFolder(tmp_path, replace(LARGE, max_frames=1))
    for seed in range(3):
        keep(folder, seed)
    folder.close()
    CollectedFolder(tmp_path, LARGE).close()
    assert (tmp_path / "images" / "mine" / "1.jpg").exists()
    assert (tmp_path / "notes.txt").read_text() == "mine"
    assert (tmp_path / "videos" / ".drive.mp4.part").exists()


@pytest.mark.parametrize(
    "linked",
    [
        "images",
        "images/{session}",
        "{image}",
        "labels",
        "labels/{session}",
        "frames",
        "{record}",
        "data.yaml",
    ],
)
def test_a_link_in_the_folder_is_refused_and_nothing_behind_it_removed(tmp_path: Path, linked: str) -> None:
    path = tmp_path / "foreign"
    collected(path, 2)
    inner = path / named(path, linked)
    inner.rename(tmp_path / "outside")
    inner.symlink_to(tmp_path / "outside")
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(CollectingError, match="found a link; replace it by a copy"):
        CollectedFolder(path, replace(LARGE, max_frames=1))
    assert sorted(tmp_path.rglob("*")) == before


def named(folder: Path, pattern: str) -> str:
    """The path of a part of `folder`, of its first image if it is of one."""
    kept = images_of(folder)[0]
    of_image = {"labels": file_of(kept.path, LABELS), "record": file_of(kept.path, FRAMES)}
    return pattern.format(session=kept.session, image=kept.path, **of_image)


@pytest.mark.parametrize(
    ("name", "max_bytes"),
    [("{image}", 256 << 20), ("{labels}", 4 << 20), ("data.yaml", 1 << 20), ("{record}", 32 << 20)],
)
def test_a_file_that_is_too_large_is_refused_before_it_is_read(
    tmp_path: Path, name: str, max_bytes: int
) -> None:
    collected(tmp_path, 1)
    os.truncate(tmp_path / named(tmp_path, name), max_bytes + 1)
    with pytest.raises(CollectingError, match=f"expected at most {max_bytes:,} bytes"):
        CollectedFolder(tmp_path, LARGE)


def test_too_many_records_are_refused_and_not_left_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    collected(tmp_path, 2)
    monkeypatch.setattr(collected_files, "MAX_IMAGES", 1)
    with pytest.raises(CollectingError, match="expected at most 1 records"):
        CollectedFolder(tmp_path, LARGE)


def test_a_damaged_record_is_left_out_and_its_image_stays(tmp_path: Path) -> None:
    collected(tmp_path, 2)
    image = images_of(tmp_path)[0].path
    (tmp_path / file_of(image, FRAMES)).write_bytes(TEXT)  # that of another image
    with closing(CollectedFolder(tmp_path, LARGE)) as folder:
        assert len(folder) == 1
    assert (tmp_path / image).exists()


def test_a_record_without_an_image_is_removed_with_its_labels(tmp_path: Path) -> None:
    collected(tmp_path, 2)
    (tmp_path / images_of(tmp_path)[0].path).unlink()
    CollectedFolder(tmp_path, LARGE).close()
    assert check(tmp_path) == 1


WRITER = """
import sys
from pathlib import Path
sys.path[:0] = {path!r}
from support.candidates import keep
from yolov5_lifecycle.collecting.collected_folder import CollectedFolder, Quota
folder = CollectedFolder(Path({folder!r}), Quota(max_bytes=1 << 30, max_frames=20, min_free_bytes=0))
for seed in range(100_000):
    keep(folder, seed, value=seed % 7)
    print(seed, flush=True)
"""


@pytest.mark.long
def test_a_process_that_is_killed_leaves_a_readable_folder(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    for _ in range(8):
        program = WRITER.format(path=sys.path, folder=os.fspath(tmp_path))
        with started([sys.executable, "-c", program], stdout=subprocess.PIPE) as writer:
            assert writer.stdout is not None
            for _ in range(int(rng.integers(1, 60))):
                assert writer.stdout.readline()
            writer.send_signal(signal.SIGKILL)
        left = images_of(tmp_path)
        assert [kept.path for kept in left] == files(tmp_path)
        assert all((tmp_path / file_of(kept.path, LABELS)).exists() for kept in left)
        CollectedFolder(tmp_path, LARGE).close()
        assert 1 <= check(tmp_path) <= 20


TEXT = RECORD.model_dump_json().encode()


def test_a_record_reads_back() -> None:
    assert CollectedFrame.of_json(TEXT) == RECORD
    assert file_of(RECORD.image, LABELS) == "labels/20261124T070343Z-0a1b2c/000001_front.txt"
    assert file_of(RECORD.image, FRAMES) == "frames/20261124T070343Z-0a1b2c/000001_front.json"


def changed(**values: Any) -> bytes:
    return json.dumps(json.loads(TEXT) | values).encode()


@pytest.mark.parametrize(
    "text",
    [
        pytest.param(TEXT[:-1], id="without its end"),
        pytest.param(changed(image="images/../../etc/1.jpg"), id="another folder"),
        pytest.param(changed(image="images/drive/000001.jpg\n"), id="a line break"),
        pytest.param(changed(image="images/drive/000001_" + "a" * 99 + ".jpg"), id="a long name"),
        pytest.param(changed(value=float("nan")), id="no number"),
        pytest.param(changed(unknown=1), id="another field"),
        pytest.param(changed(embedding="%"), id="no base64"),
        pytest.param(changed(embedding="AA=="), id="half a number"),
        pytest.param(changed(embedding="/38="), id="an embedding that is NaN"),
        pytest.param(changed(shades="AAAA"), id="too few shades"),
    ],
)
def test_what_is_no_record_is_refused(text: bytes) -> None:
    with pytest.raises(ValueError, match=r"."):
        CollectedFrame.of_json(text)


@pytest.mark.parametrize("value", [b"0", b"[]", b"{}"])
def test_a_record_is_refused_before_its_many_values_are_built(value: bytes) -> None:
    text = TEXT[:-1] + b', "objects": [' + b",".join([value] * 300_001) + b"]}"
    with pytest.raises(ValueError, match="at most 300000 values, lists and objects"):
        CollectedFrame.of_json(text)


def embedding_of(text: str) -> NDArray[np.float32]:
    return RECORD.model_copy(update={"embedding": text}).descriptor()[0]


def test_an_embedding_keeps_its_direction() -> None:
    wanted = look_of(1) * 1000
    stored = embedding_of(embedding_text(wanted))
    assert np.linalg.norm(stored) == pytest.approx(1, abs=1e-3)
    np.testing.assert_allclose(stored, wanted / np.linalg.norm(wanted), atol=1e-3)


@pytest.mark.parametrize("value", [0, np.nan, np.inf])
def test_an_embedding_without_direction_is_empty(value: float) -> None:
    assert embedding_of(embedding_text(np.full(4, value, np.float32))).shape == (0,)
