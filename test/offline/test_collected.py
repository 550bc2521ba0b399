"""The command `collected`: what a detector has collected, looked at, split and removed."""

from __future__ import annotations

import base64
import os
import re
import subprocess
import time
from collections import Counter
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from support.candidates import CLASS_NAMES, add, candidate, found, frames_of, images_of, keep

from yolov5_lifecycle.collecting import collected_files
from yolov5_lifecycle.collecting.candidate import Detail, Trigger
from yolov5_lifecycle.collecting.collected_files import FRAMES, LABELS, CollectedFrame, file_of
from yolov5_lifecycle.collecting.collected_folder import CollectedFolder, Quota, RecordingSession
from yolov5_lifecycle.evaluation.ground_truth import LabelledPath, Problems
from yolov5_lifecycle.evaluation.yolo_folder import read_yolo_folder
from yolov5_lifecycle.offline.collected.command import main, validation_sessions
from yolov5_lifecycle.ros.child_process import entry_point

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


def write_record(folder: Path, frame: CollectedFrame) -> None:
    (folder / file_of(frame.image, FRAMES)).write_text(frame.model_dump_json())


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


@pytest.mark.end_to_end
def test_the_command_shows_what_is_there_as_a_process(tmp_path: Path) -> None:
    folder = collected(tmp_path / "robot", 2)
    ended = subprocess.run(
        [entry_point("collected"), "show", folder], capture_output=True, text=True, check=False
    )
    assert (ended.returncode, ended.stderr) == (0, "")
    assert ended.stdout.startswith("images         2\n")


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
    write_record(folder, changed)
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
    commands = ("show", "split", "remove --session nothing", f"sheet --output {new}")
    for action, *options in map(str.split, commands):
        assert run(action, robot, *options) == 1
        assert "found a link; replace it by a copy" in capsys.readouterr().err
    assert sorted(tmp_path.rglob("*")) == before


def test_records_that_are_too_large_together_are_not_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(collected_files, "MAX_RECORDS_BYTES", 1000)
    assert run("show", collected(tmp_path / "robot", 2)) == 1
    assert "expected at most 1,000 bytes, found more; use another folder" in capsys.readouterr().err


def test_a_folder_whose_name_is_no_text_has_a_sheet(tmp_path: Path) -> None:
    folder = collected(tmp_path / os.fsdecode(b"robot\xff"), 1)
    assert run("sheet", folder, "--output", tmp_path / "sheet.html") == 0
    assert "robot?" in (tmp_path / "sheet.html").read_text()


@pytest.mark.long
def test_thirty_thousand_names_cost_no_more_than_their_number(tmp_path: Path) -> None:
    folder = collected(tmp_path / "robot", 1)
    (frame,) = frames_of(folder)
    objects = [frame.objects[0].model_copy(update={"class_name": f"{number:05}"}) for number in range(30_000)]
    write_record(folder, frame.model_copy(update={"objects": tuple(objects)}))
    begin_s = time.process_time()
    assert run("sheet", folder, "--output", tmp_path / "sheet.html") == 0
    assert time.process_time() - begin_s < 2


def test_twenty_thousand_sessions_cost_no_more_than_their_number() -> None:
    counts = Counter({f"{session}": 1 for session in range(20_000)})
    begin_s = time.process_time()
    assert len(validation_sessions(counts, 0.2)) == 5000
    assert time.process_time() - begin_s < 1


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
        (["split", "nameless"], "data.yaml is missing"),
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
    (collected(tmp_path / "nameless", 1, 1) / "data.yaml").unlink()
    try:
        code = run(*words)
    except SystemExit as end:
        code = int(end.code or 0)
    assert code in (1, 2)
    assert message in capsys.readouterr().err
