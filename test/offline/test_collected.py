"""The command `collected`: what a detector has collected, looked at, merged, split and removed."""

from __future__ import annotations

import base64
import os
import re
import shutil
from collections import Counter
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from support.candidates import CLASS_NAMES, add, candidate, found, frames_of, images_of, keep

from yolov5_lifecycle.collecting import collected_files
from yolov5_lifecycle.collecting.candidate import Detail, Trigger
from yolov5_lifecycle.collecting.collected_files import FRAMES, LABELS, file_of, with_names
from yolov5_lifecycle.collecting.collected_folder import CollectedFolder, Quota, RecordingSession
from yolov5_lifecycle.evaluation.ground_truth import LabelledPath, Problems
from yolov5_lifecycle.evaluation.yolo_folder import read_yolo_folder
from yolov5_lifecycle.offline.collected import command
from yolov5_lifecycle.offline.collected.command import main, validation_sessions

QUOTA = Quota(max_bytes=1 << 30, max_frames=1000, min_free_bytes=0)


def collected(folder: Path, *counts: int, names: tuple[str, ...] = CLASS_NAMES) -> Path:
    """A folder with sessions of so many images of a cat."""
    for place, count in enumerate(counts):
        session = RecordingSession()
        session.name = f"{place}-{session.name}"
        with closing(CollectedFolder(folder, QUOTA, session=session)) as into:
            for number in range(count):
                keep(into, 100 * place + number, names=names)
    return folder


def sessions(folder: Path) -> list[str]:
    return list(dict.fromkeys(kept.session for kept in images_of(folder)))


def run(*words: object) -> int:
    return main([str(word) for word in words])


def test_what_is_there_is_counted(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = collected(tmp_path / "robot", 2, 1)
    assert run("show", folder) == 0
    first, second = sessions(folder)
    assert capsys.readouterr().out.splitlines() == [
        "images         3",
        f"session        2  {first}",
        f"session        1  {second}",
        "camera         3  (without a name)",
        "model          3  abababababab",
        "reason         3  class",
        "class          3  cat",
    ]


def test_the_sheet_is_one_page_with_every_image_and_its_reason(tmp_path: Path) -> None:
    folder = collected(tmp_path / "robot <1>", 2)
    with closing(CollectedFolder(folder, QUOTA)) as into:
        white = replace(candidate(7).image, pixels=np.full((900, 1600, 3), 255, np.uint8))
        box = found(("dog", 0.9, (400, 200, 1200, 700)))
        reasons = {Trigger.NOVEL: Detail("<script>alert(1)</script>")}
        add(into, candidate(7, image=white, detections=box, reasons=reasons))
    sheet = tmp_path / "sheet.html"
    assert run("sheet", folder, "--output", sheet) == 0
    page = sheet.read_text()
    assert re.findall(r"<h2>(.*?)</h2>", page) == ["class: 2", "novel: 1"]
    assert "<script" not in page
    assert "3 collected images: robot &lt;1&gt;" in page
    assert "http" not in page
    assert [max(picture.shape) for picture in pictures(page)] == [64, 64, 320]
    white_box = pictures(page)[2]
    assert white_box[90, 160].min() > 240  # in the box
    assert white_box[40:140, 75:85].min() < 200  # its left side


def test_a_class_has_the_same_colour_in_every_image(tmp_path: Path) -> None:
    white = replace(candidate(0).image, pixels=np.full((300, 300, 3), 255, np.uint8))
    dog, cat = found(("dog", 0.9, (100, 100, 200, 200))), found(("cat", 0.9, (10, 100, 60, 200)))
    both = found(("cat", 0.9, (10, 100, 60, 200)), ("dog", 0.8, (100, 100, 200, 200)))
    with closing(CollectedFolder(tmp_path / "robot", QUOTA)) as into:
        for seed, detections in enumerate([dog, both, cat]):
            add(into, candidate(seed, image=white, detections=detections))
    assert run("sheet", tmp_path / "robot", "--output", tmp_path / "sheet.html") == 0
    alone, together, _ = pictures((tmp_path / "sheet.html").read_text())
    np.testing.assert_allclose(alone[150, 100].astype(int), together[150, 100], atol=30)


def pictures(page: str) -> list[NDArray[np.uint8]]:
    return [
        np.asarray(cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), cv2.IMREAD_COLOR), np.uint8)
        for data in re.findall(r'base64,([^"]+)"', page)
    ]


def test_the_sheet_has_the_most_valuable_images_and_replaces_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = collected(tmp_path / "robot", 3)
    sheet = tmp_path / "sheet.html"
    assert run("sheet", folder, "--output", sheet, "--most", 2) == 0
    assert sheet.read_text().count("<figure>") == 2
    assert run("sheet", folder, "--output", sheet) == 1
    assert "exists" in capsys.readouterr().err


def test_an_image_that_cannot_be_read_is_told_in_its_place(tmp_path: Path) -> None:
    folder = collected(tmp_path / "robot", 2)
    (folder / frames_of(folder)[0].image).write_bytes(b"no image")
    assert run("sheet", folder, "--output", tmp_path / "sheet.html") == 0
    page = (tmp_path / "sheet.html").read_text()
    assert page.count("<img") == 1
    assert page.count("<figure>") == 2


def test_a_box_from_elsewhere_does_not_end_the_sheet(tmp_path: Path) -> None:
    folder = collected(tmp_path / "robot", 1)
    (frame,) = frames_of(folder)
    strange = frame.objects[0].model_copy(update={"box_xyxy": (1e308, -1e308, -5.0, 7.0)})
    changed = frame.model_copy(update={"objects": (strange, *frame.objects)})
    (folder / file_of(frame.image, FRAMES)).write_text(changed.model_dump_json())
    assert run("sheet", folder, "--output", tmp_path / "sheet.html") == 0


def test_whole_sessions_are_for_training_or_validation(tmp_path: Path) -> None:
    folder = collected(tmp_path / "robot", 6, 2, 2)
    assert run("split", folder, "--share", 0.2) == 0
    parts = {
        name: {path.path.parent.name for path in labelled(folder / "split.yaml", name)}
        for name in ("train", "val")
    }
    assert len(labelled(folder / "split.yaml", "val")) == 2
    assert len(labelled(folder / "split.yaml", "train")) == 8
    assert parts["train"].isdisjoint(parts["val"])


def labelled(data: Path, split: str) -> tuple[LabelledPath, ...]:
    told: list[str] = []
    images = read_yolo_folder(data, Problems(told.append), split=split).images
    assert told == []
    return images


@pytest.mark.parametrize(
    ("counts", "share", "validation"),
    [
        ([9, 1], 0.2, [1]),
        ([4, 3, 3], 0.3, [1]),
        ([1] * 10, 0.2, [0, 1]),
        ([1, 1], 0.99, [0]),
    ],
)
def test_validation_has_about_its_share(counts: list[int], share: float, validation: list[int]) -> None:
    by_session = Counter({f"{session:02d}": count for session, count in enumerate(counts)})
    assert validation_sessions(by_session, share) == [f"{session:02d}" for session in validation]


def test_folders_of_several_robots_become_one_with_classes_by_name(tmp_path: Path) -> None:
    one = collected(tmp_path / "one", 2)
    other = collected(tmp_path / "other", 1, names=("bird", "cat"))
    corrected = next((one / "labels").rglob("*.txt"))
    corrected.write_text("1 0.5 0.5 0.5 0.5\n\n0 0.5 0.5 0.25 0.25 0.75 0.75\n")
    assert run("merge", one, other, "--output", tmp_path / "all") == 0
    told: list[str] = []
    data = read_yolo_folder(tmp_path / "all", Problems(told.append))
    assert (data.class_names, told) == (("cat", "dog", "bird"), [])
    assert sorted(image.labels.boxes.class_ids.tolist() for image in data.images) == [[0], [1, 0], [2]]
    assert len(frames_of(tmp_path / "all")) == 3
    with closing(CollectedFolder(tmp_path / "all", QUOTA)) as merged:
        assert len(merged) == 3


def test_an_image_of_several_folders_is_merged_once_with_the_labels_of_the_first(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    robot = collected(tmp_path / "robot", 2)
    corrected = tmp_path / "corrected"
    shutil.copytree(robot, corrected)
    labels = next((corrected / "labels").rglob("000001*.txt"))
    labels.write_text("1 0.5 0.5 0.5 0.5\n")
    assert run("merge", corrected, robot, "--output", tmp_path / "all") == 0
    assert "2 images; 2 that a folder before had" in capsys.readouterr().out
    assert len(frames_of(tmp_path / "all")) == 2
    assert (tmp_path / "all" / labels.relative_to(corrected)).read_text() == labels.read_text()


@pytest.mark.parametrize(
    ("line", "told"),
    [
        pytest.param("9 0.5 0.5 0.5 0.5\n", "expected a class from 0 to 1", id="class"),
        pytest.param("0 0.5 0.5 0.5 0.5\n" * 10_001, "found 10001 objects", id="many objects"),
    ],
)
def test_labels_that_cannot_be_used_are_not_merged(
    line: str, told: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    one = collected(tmp_path / "one", 1)
    next((one / "labels").rglob("*.txt")).write_text(line)
    assert run("merge", one, "--output", tmp_path / "all") == 1
    assert told in capsys.readouterr().err


@pytest.mark.parametrize("line", ["0\v0.5 0.5 0.2 0.2", "0 0.5\u20280.5 0.2 0.2", "0 0.5 0.5 0.2 0.2\x85"])
def test_a_line_of_labels_stays_one_line(tmp_path: Path, line: str) -> None:
    robot = collected(tmp_path / "robot", 1)
    next((robot / "labels").rglob("*.txt")).write_text(line)
    assert run("merge", robot, "--output", tmp_path / "all") == 0
    (merged,) = (tmp_path / "all" / "labels").rglob("*.txt")
    assert merged.read_text() == "0 0.5 0.5 0.2 0.2\n"


@pytest.mark.parametrize("linked", ["{image}", "{labels}", "{record}", FRAMES])
def test_a_folder_with_a_link_is_refused_and_nothing_behind_it_read(
    tmp_path: Path, linked: str, capsys: pytest.CaptureFixture[str]
) -> None:
    robot, new = collected(tmp_path / "robot", 1, 1), tmp_path / "new"
    image = images_of(robot)[0].path
    inner = robot / linked.format(image=image, labels=file_of(image, LABELS), record=file_of(image, FRAMES))
    inner.rename(tmp_path / "outside")
    inner.symlink_to(tmp_path / "outside")
    before = sorted(tmp_path.rglob("*"))
    commands = ("show", "split", "remove --session nothing", f"sheet --output {new}", f"merge --output {new}")
    for action, *options in map(str.split, commands):
        assert run(action, robot, *options) == 1
        assert "found a link; replace it by a copy" in capsys.readouterr().err
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize("what", ["images", "classes"])
def test_folders_that_are_no_data_set_together_are_not_merged(
    tmp_path: Path, what: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folders = collected(tmp_path / "one", 1), collected(tmp_path / "other", 1, names=("bird",))
    monkeypatch.setattr(command, f"MAX_{what.upper()}", 1 if what == "images" else 2, raising=False)
    assert run("merge", *folders, "--output", tmp_path / "all") == 1
    assert f"{what}, found" in capsys.readouterr().err


def test_records_that_are_too_large_together_are_not_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(collected_files, "MAX_RECORDS_BYTES", 1000)
    assert run("show", collected(tmp_path / "robot", 2)) == 1
    assert "expected at most 1,000 bytes, found more; use another folder" in capsys.readouterr().err


def test_more_than_the_disk_can_take_is_not_begun(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    robot = collected(tmp_path / "robot", 1)
    monkeypatch.setattr("shutil.disk_usage", lambda path: SimpleNamespace(free=1000))
    assert run("merge", robot, "--output", tmp_path / "all") == 1
    assert "expected at most 1,000 bytes, which are free on the disk, found" in capsys.readouterr().err


def test_a_folder_whose_name_is_no_text_has_a_sheet(tmp_path: Path) -> None:
    folder = collected(tmp_path / os.fsdecode(b"robot\xff"), 1)
    assert run("sheet", folder, "--output", tmp_path / "sheet.html") == 0
    assert "robot?" in (tmp_path / "sheet.html").read_text()


def test_many_names_and_sessions_are_handled_before_a_cost_with_their_square_would_end() -> None:
    many = [f"{number}" for number in range(400_000)]
    assert len(with_names(many, reversed(many))) == len(many)
    assert len(validation_sessions(Counter(many), 0.2)) == len(many) // 4


def test_images_of_a_session_or_of_a_reason_are_removed(tmp_path: Path) -> None:
    folder = collected(tmp_path / "robot", 2, 3)
    with closing(CollectedFolder(folder, QUOTA)) as into:
        add(into, candidate(9, reasons={Trigger.CLASS: Detail(""), Trigger.NOVEL: Detail("")}))
    first, *_ = sessions(folder)
    assert run("remove", folder, "--session", first) == 0
    assert len(frames_of(folder)) == 4
    assert run("remove", folder, "--reason", "class") == 0
    (left,) = frames_of(folder)
    assert {*left.reasons} == {"class", "novel"}
    assert len(list(folder.rglob("*.jpg"))) == len(list(folder.rglob("*.txt"))) == 1


def test_nothing_is_removed_while_a_detector_collects(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = collected(tmp_path / "robot", 2)
    with closing(CollectedFolder(folder, QUOTA)):
        assert run("remove", folder, "--reason", "class") == 1
    assert "another process" in capsys.readouterr().err
    assert len(frames_of(folder)) == 2


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["split", "one session"], "at least two sessions, found 1"),
        (["merge", "nameless", "--output", "new"], "data.yaml is missing"),
        (["show", "missing"], "expected the collect_dir of a detector"),
        (["remove", "."], "remove needs --session or --reason"),
        (["split", ".", "--share", "1"], "between 0 and 1"),
        (["sheet", ".", "--output", "x", "--most", "0"], "from 1 to 10000"),
        (["sheet", ".", "--output", "x", "--most", "all"], "expected a number of images from 1 to 10000"),
        ([], "ACTION"),
    ],
)
def test_what_cannot_be_done_is_told(
    words: list[str],
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    collected(tmp_path / "one session", 1)
    (collected(tmp_path / "nameless", 1) / "data.yaml").unlink()
    try:
        code = run(*words)
    except SystemExit as end:
        code = int(end.code or 0)
    assert code in (1, 2)
    assert message in capsys.readouterr().err
