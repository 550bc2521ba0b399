"""The command `collected`: what a detector has collected, looked at and split."""

from __future__ import annotations

import re
import subprocess
from collections import Counter
from contextlib import closing
from pathlib import Path

import pytest
from support.candidates import CLASS_NAMES, frames_of, images_of, keep
from support.colcon_workspace import REPOSITORY
from support.refusals import Refused

from yolov5_lifecycle.collecting import collected_files
from yolov5_lifecycle.collecting.collected_folder import CollectedFolder, Quota, RecordingSession
from yolov5_lifecycle.evaluation.ground_truth import LabelledImage, Problems
from yolov5_lifecycle.evaluation.yolo_folder import read_yolo_folder
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


def run(*words: object) -> int:
    return main([str(word) for word in words])


def test_what_is_there_is_counted(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = collected(tmp_path / "robot", 2, 1)
    assert run("show", folder) == 0
    first, second = dict.fromkeys(kept.session for kept in images_of(folder))
    assert capsys.readouterr().out.splitlines() == [
        "images         3",
        f"session        2  {first}",
        f"session        1  {second}",
        "camera         3  (without a name)",
        "model          3  abababababab",
        "reason         3  class",
        "class          3  cat",
    ]


@pytest.mark.parametrize("action", ["show", "split"])
def test_images_without_a_record_are_told(
    tmp_path: Path, action: str, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = collected(tmp_path / "robot", 2, 1)
    (folder / "images" / "own").mkdir()
    for name in ("a.jpg", "b.PNG", "notes.txt"):
        (folder / "images" / "own" / name).touch()
    assert run(action, folder) == 0
    assert "collected: 2 images in " in capsys.readouterr().err


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


def labelled(data: Path, split: str) -> tuple[LabelledImage, ...]:
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


def copied_into_one(folder: Path) -> bool:
    """Whether the command in the page for the folders of several robots made one of those in `folder`."""
    page = (REPOSITORY / "docs" / "data-loop.md").read_text()
    (command,) = re.findall(r"`(.*cp .*)`", page)
    return subprocess.run(command, shell=True, cwd=folder, check=False).returncode == 0


def test_folders_of_several_robots_become_one_with_all_that_they_have(tmp_path: Path) -> None:
    one, other = collected(tmp_path / "robot_1", 2, 1), collected(tmp_path / "robot_2", 3)
    corrected = next((one / "labels").rglob("*.txt"))
    corrected.write_text("1 0.5 0.5 0.5 0.5\n")
    assert run("split", one) == 0
    assert copied_into_one(tmp_path)
    both = tmp_path / "all"
    assert (both / corrected.relative_to(one)).read_text() == corrected.read_text()
    assert sorted(map(repr, frames_of(both))) == sorted(map(repr, (*frames_of(one), *frames_of(other))))
    assert run("split", both) == 0
    assert len(labelled(both / "split.yaml", "train")) + len(labelled(both / "split.yaml", "val")) == 6
    assert len(labelled(both, "train")) == 6
    with closing(CollectedFolder(both, QUOTA)) as opened:
        assert (len(opened), opened.class_names) == (6, CLASS_NAMES)


def test_folders_whose_class_numbers_differ_do_not_become_one(tmp_path: Path) -> None:
    collected(tmp_path / "robot_1", 1)
    collected(tmp_path / "robot_2", 1, names=CLASS_NAMES[::-1])
    assert not copied_into_one(tmp_path)
    assert not (tmp_path / "all").exists()


def test_records_that_are_too_large_together_are_not_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, refused: Refused
) -> None:
    monkeypatch.setattr(collected_files, "MAX_RECORDS_BYTES", 1000)
    told = refused(main, "show", collected(tmp_path / "robot", 2))
    assert "expected at most 1,000 bytes, found more; use another folder" in told


def test_many_sessions_are_handled_before_a_cost_with_their_square_would_end() -> None:
    many = [f"{number}" for number in range(400_000)]
    assert len(validation_sessions(Counter(many), 0.2)) == len(many) // 4


@pytest.mark.parametrize(
    ("words", "code", "message"),
    [
        (["split", "one session"], 1, "at least two sessions, found 1"),
        (["split", "nameless"], 1, "data.yaml is missing"),
        (["show", "missing"], 1, "expected the collect_dir of a detector"),
        (["split", ".", "--share", "1"], 2, "between 0 and 1"),
        ([], 2, "ACTION"),
    ],
)
def test_what_cannot_be_done_is_told(
    words: list[str], code: int, message: str, tmp_path: Path, refused: Refused
) -> None:
    collected(tmp_path / "one session", 1)
    (collected(tmp_path / "nameless", 1, 1) / "data.yaml").unlink()
    assert message in refused(main, *words, code=code)
