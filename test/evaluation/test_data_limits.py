"""Data sets are refused before a size that they claim is paid."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from yolov5_lifecycle.evaluation import coco_file, yolo_folder
from yolov5_lifecycle.evaluation.coco_file import read_coco_file
from yolov5_lifecycle.evaluation.ground_truth import DataError, Problems
from yolov5_lifecycle.evaluation.yolo_folder import read_yolo_folder
from yolov5_lifecycle.evaluation.yolo_labels import MAX_BYTES, MAX_LINES, label_text, parsed_labels

BOX = "0 0.5 0.5 0.2 0.2\n"
LIMIT = 4


def refusal(read: Callable[..., Any], data: Path) -> str:
    with pytest.raises(DataError) as refused:
        read(data, Problems(lambda _: None))
    assert len(str(refused.value)) < 1000
    return str(refused.value)


def labelled_images(folder: Path, count: int, *, objects: int = 1) -> Path:
    """A data set of `count` images, which nobody opens here."""
    for name in ("images", "labels"):
        (folder / name).mkdir(parents=True)
    lines = "".join(f"0 0.5 0.5 0.2 0.{number + 1}\n" for number in range(objects))
    for number in range(count):
        (folder / "images" / f"{number}.jpg").touch()
        (folder / "labels" / f"{number}.txt").write_text(lines)
    return folder


def test_a_list_of_two_million_repeated_lines_is_refused(tmp_path: Path) -> None:
    (tmp_path / "1.jpg").touch()
    (tmp_path / "val.txt").write_text("1.jpg\n" * 2_000_000)
    (tmp_path / "data.yaml").write_text("val: val.txt\n")
    told = refusal(read_yolo_folder, tmp_path)
    assert "val.txt: expected at most 250,000 lines in the lists of images, found 250,001 or more" in told


def test_a_repeated_line_is_read_once_and_a_repeated_list_too(tmp_path: Path) -> None:
    labelled_images(tmp_path, 1)
    (tmp_path / "val.txt").write_text("images/0.jpg\n" * 1000)
    (tmp_path / "data.yaml").write_text(f"val: [{', '.join(['val.txt'] * 1000)}]\n")
    assert len(read_yolo_folder(tmp_path, Problems(lambda _: None)).images) == 1


def test_the_lines_of_all_lists_count_together(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(yolo_folder, "MAX_IMAGES", LIMIT)
    labelled_images(tmp_path, 1)
    for name in ("a.txt", "b.txt"):
        (tmp_path / name).write_text("images/0.jpg\n" * 3)
    (tmp_path / "data.yaml").write_text("val: [a.txt, b.txt]\n")
    assert "b.txt: expected at most 4 lines in the lists of images, found 6" in refusal(
        read_yolo_folder, tmp_path
    )


@pytest.mark.parametrize(
    ("name", "objects", "told"),
    [
        pytest.param("MAX_IMAGES", 1, "expected at most 4 images in a data set, found 5", id="images"),
        pytest.param("MAX_OBJECTS", 3, "expected at most 4 objects in a data set, found 6", id="objects"),
        pytest.param(
            "MAX_LABEL_CHARACTERS", 1, "expected at most 4 characters in label files, found 18", id="text"
        ),
    ],
)
def test_a_folder_with_more_than_a_limit_is_refused(
    name: str, objects: int, told: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    labelled_images(tmp_path, LIMIT + 1, objects=objects)
    monkeypatch.setattr(yolo_folder, name, LIMIT)
    assert told in refusal(read_yolo_folder, tmp_path)


@pytest.mark.parametrize("text", ["\n", BOX, "\r", BOX.replace("\n", "\r\n")])
def test_a_label_file_of_too_many_lines_is_broken(text: str) -> None:
    with pytest.raises(DataError, match="more than 20000 lines"):
        parsed_labels(text * (MAX_LINES + 1), 1)


def test_a_label_file_that_is_too_large_is_broken(tmp_path: Path) -> None:
    path = tmp_path / "1.txt"
    path.write_text(" " * (MAX_BYTES + 1))
    with pytest.raises(DataError, match="more than 4194304 bytes"):
        label_text(path)


@pytest.mark.parametrize(
    ("name", "key", "told"),
    [
        ("MAX_IMAGES", "images", "expected at most 4 images, found 5"),
        ("MAX_OBJECTS", "annotations", "expected at most 4 annotations, found 5"),
        ("MAX_CLASSES", "categories", "expected at most 4 categories, found 5"),
    ],
)
def test_a_coco_file_with_more_than_a_limit_is_refused(
    name: str, key: str, told: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "truth.json"
    lists: dict[str, list[int]] = {"images": [], "annotations": [], "categories": []}
    path.write_text(json.dumps({**lists, key: [1] * (LIMIT + 1)}))
    monkeypatch.setattr(coco_file, name, LIMIT)
    assert told in refusal(read_coco_file, path)


def test_progress_is_shown_while_labels_are_read(tmp_path: Path) -> None:
    shown: list[str] = []
    read_yolo_folder(labelled_images(tmp_path, 2), Problems(lambda _: None, progress=shown.append))
    assert shown == ["looking for images", "labels: 0 of 2 images"]
