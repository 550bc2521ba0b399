"""Data sets in YOLO format: what belongs to them, labels, and that nothing outside of them is read."""

from __future__ import annotations

import os
import re
from pathlib import Path

import numpy as np
import pytest

from yolov5_lifecycle.evaluation import yolo_folder
from yolov5_lifecycle.evaluation.ground_truth import MAX_BOXES_PER_IMAGE, DataError, LabelledFolder, Problems
from yolov5_lifecycle.evaluation.yolo_folder import (
    MAX_LABEL_BYTES,
    MAX_LINES,
    label_text,
    parsed_labels,
    read_yolo_folder,
)

BOX = "0 0.5 0.5 0.2 0.2\n"
NAMES = "names: [cat, dog]\n"
SPLIT = "images/val/1 images/train/2"
BOTH = "images/train/2.jpg images/val/1.jpg"


def data_set(folder: Path, description: str | None, *labelled: str) -> Path:
    """A data set with images, which nobody opens here, and labels at the paths `labelled`."""
    folder.mkdir(exist_ok=True)
    if description is not None:
        (folder / "data.yaml").write_text(description)
    for name in labelled:
        for path, text in ((folder / f"{name}.jpg", ""), (folder / _label_name(name), BOX)):
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)
    return folder


def _label_name(name: str) -> str:
    head, images, tail = name.rpartition("images/")
    return f"{head}labels/{tail}.txt" if images else f"{name}.txt"


class Told:
    """Reads a data set and keeps the reported problems."""

    def __init__(self) -> None:
        self.lines: list[str] = []
        self.problems = Problems(self.lines.append)

    def read(self, data: Path, split: str | None = None, root: Path | None = None) -> LabelledFolder:
        return read_yolo_folder(data, self.problems, split=split, root=root)

    def names(self, data: Path, split: str | None = None) -> list[str]:
        """The images relative to `data`, all with one box, sorted."""
        images = self.read(data, split).images
        assert all(len(image.boxes) == 1 for image in images)
        folder = data if data.is_dir() else data.parent
        return sorted(str(image.path.relative_to(folder)) for image in images)


@pytest.mark.parametrize(
    ("description", "labelled", "found"),
    [
        pytest.param(None, "images/1 images/a/2", "images/1.jpg images/a/2.jpg", id="no yaml"),
        pytest.param(None, "1 a/2", "1.jpg a/2.jpg", id="no yaml, labels beside images"),
        pytest.param("val: images/val\ntrain: images/train\n", SPLIT, "images/val/1.jpg", id="val"),
        pytest.param("path: ~\ntrain: images/train\nval: null\n", SPLIT, "images/train/2.jpg", id="val null"),
        pytest.param("val: [images/val, images/train]\n", SPLIT, BOTH, id="several"),
        pytest.param("path: below\nval: images\n", "below/images/1", "below/images/1.jpg", id="path"),
        pytest.param("path: /elsewhere\nval: images\n", "images/1", "images/1.jpg", id="path elsewhere"),
        pytest.param(
            "val: ../valid/images\nroboflow:\n  a: {b: [c, 1]}\n",
            "valid/images/1",
            "valid/images/1.jpg",
            id="as Roboflow writes",
        ),
        pytest.param("val: shots\n", "shots/1", "shots/1.jpg", id="labels beside images"),
        pytest.param("val: images/1.jpg\n", "images/1 images/2", "images/1.jpg", id="one image"),
    ],
)
def test_the_images_are_those_of_the_entry(
    description: str | None, labelled: str, found: str, tmp_path: Path
) -> None:
    text = None if description is None else description + NAMES
    data = data_set(tmp_path / "data", text, *labelled.split())
    for path in (data, data / "data.yaml") if text else (data,):
        assert Told().names(path) == found.split()


def test_the_split_chooses_the_entry(tmp_path: Path) -> None:
    text = f"val: images/val\ntrain: images/train\n{NAMES}"
    data = data_set(tmp_path / "data", text, *SPLIT.split())
    assert Told().names(data, "train") == ["images/train/2.jpg"]
    with pytest.raises(DataError, match=r"there is no entry 'test', only: val, train\."):
        Told().read(data, "test")


def test_a_folder_of_images_has_its_labels_where_yolov5_looks_for_them(tmp_path: Path) -> None:
    data = data_set(tmp_path / "data", None, "images/train/1", "images/val/2")
    assert Told().names(data / "images") == ["train/1.jpg", "val/2.jpg"]
    assert Told().names(data / "images" / "val") == ["2.jpg"]


def test_labels_lie_beside_images_also_below_another_folder_called_images(tmp_path: Path) -> None:
    data = data_set(tmp_path, None, "images/shots/1")
    (data / "labels" / "shots" / "1.txt").rename(data / "images" / "shots" / "1.txt")
    assert Told().names(data / "images" / "shots") == ["1.jpg"]


def test_a_list_names_images_relative_to_itself(tmp_path: Path) -> None:
    data = data_set(tmp_path / "data", f"val: val.txt\n{NAMES}", "images/1", "images/2", "images/3")
    (data / "val.txt").write_text(
        "./images/1.jpg\n\nimages/3.jpg\n../secret.jpg\n/etc/passwd\nimages/1.jpg\n"
    )
    told = Told()
    assert told.names(data) == ["images/1.jpg", "images/3.jpg"]
    assert told.problems.counts == {"unusable entries": 2}
    assert "'../secret.jpg' lies outside of" in told.lines[0]


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_texts_may_have_byte_order_marks_where_files_were_joined_too(encoding: str, tmp_path: Path) -> None:
    data = data_set(tmp_path / "data", None, "images/1")
    (data / "data.yaml").write_text(f"val: val.txt\n{NAMES}", encoding=encoding)
    (data / "val.txt").write_text("images/1.jpg\n", encoding=encoding)
    (data / "labels" / "1.txt").write_text(f"\ufeff{BOX}", encoding=encoding)
    told = Told()
    assert (told.names(data), told.lines) == (["images/1.jpg"], [])


@pytest.mark.parametrize(
    ("line", "told"),
    [
        pytest.param(
            r"images\1.jpg", r"a path of Windows; type sed -i 's\|\\\\\|/\|g' FILE[^;]*$", id="backslash"
        ),
        pytest.param("C:/a/images/1.jpg", "a path of Windows; make it relative to ", id="drive"),
        pytest.param("../there.jpg", "; --root names the folder that may be read", id="outside"),
        pytest.param("../missing.jpg", "lies outside of [^;]*$", id="outside and missing"),
        pytest.param("/home/them/images/1.jpg", "lies outside of [^;]*$", id="of another computer"),
        pytest.param("a\0.jpg", "expected the path of a file or folder", id="null character"),
        pytest.param("x" * 5000 + ".jpg", "expected the path of a file or folder", id="long"),
    ],
)
def test_a_line_of_a_list_that_names_nothing_here_says_what_helps(
    line: str, told: str, tmp_path: Path
) -> None:
    data = data_set(tmp_path / "data", f"val: [val.txt, images]\n{NAMES}", "images/1", "../there")
    (data / "val.txt").write_text(f"{line}\n")
    reader = Told()
    assert reader.names(data) == ["images/1.jpg"]
    assert re.search(told, reader.lines[0])


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        pytest.param("names: {1: dog, 0: cat}", ("cat", "dog"), id="mapping in disorder"),
        pytest.param("names: [no, 1, 007, '2']", ("no", "1", "007", "2"), id="as they are written"),
        pytest.param("nc: 2", None, id="none"),
    ],
)
def test_class_names(names: str, expected: tuple[str, ...] | None, tmp_path: Path) -> None:
    data = data_set(tmp_path / "data", f"val: images\n{names}\n", "images/1")
    assert Told().read(data).class_names == expected


def test_what_is_broken_is_listed_and_the_rest_is_read(tmp_path: Path) -> None:
    data = data_set(
        tmp_path / "data", f"val: images\n{NAMES}", *(f"images/{number:02}" for number in range(20))
    )
    for number in range(15):
        (data / "labels" / f"{number:02}.txt").write_text("7 0.5 0.5 0.2 0.2\n")
    (data / "labels" / "19.txt").unlink()
    told = Told()
    images = told.read(data).images
    assert [image.path.stem for image in images] == ["15", "16", "17", "18", "19"]
    assert len(images[-1].boxes) == 0, "an image without a label file shows nothing"
    assert told.problems.counts == {"broken labels": 15}
    assert len(told.lines) == 11
    assert told.lines[0].startswith("broken labels: ")
    assert "labels/00.txt: line 1: expected a class from 0 to 1, found 7" in told.lines[0]
    assert told.lines[-1] == "further problems are only counted"


def aliases(depth: int) -> str:
    """A YAML bomb."""
    lines = ["a0: &a0 [x]"]
    lines += [f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 9)}]" for n in range(1, depth)]
    return "\n".join(lines)


@pytest.mark.parametrize(
    ("description", "reason"),
    [
        pytest.param(aliases(9), "an alias", id="bomb"),
        pytest.param("names: " + "[" * 5000, "nested more than 20 deep", id="deep"),
        pytest.param("x: " + "x" * (1 << 21), "1048576 bytes, the limit", id="large"),
        pytest.param("[1, 2]", "expected names and values", id="list"),
        pytest.param("names: {0: cat, 10000: dog}", "numbered from 0 to 9999, found 10000", id="huge id"),
        pytest.param("names: [" + "x, " * 10_001 + "]", "of 0 to 10000 classes, found 10001", id="many"),
        pytest.param("names: [[cat]]", "strings or numbers, found a list", id="nested names"),
        pytest.param("val: {a: b}", "must be paths", id="mapping as path"),
        pytest.param("val: ../../etc\nnames: [cat]", "there are no images", id="traversal"),
        pytest.param("val: missing\nnames: [cat]", "there are no images", id="missing"),
        pytest.param("", "none of 1 images has a label file", id="no labels"),
    ],
)
def test_a_data_set_of_which_nothing_can_be_used_is_refused(
    description: str, reason: str, tmp_path: Path
) -> None:
    data = data_set(tmp_path / "data", description)
    (data / "images").mkdir()
    (data / "images" / "1.jpg").touch()
    with pytest.raises(DataError) as refused:
        Told().read(data)
    assert reason in str(refused.value)
    assert len(str(refused.value)) < 1000


def test_a_folder_with_several_descriptions_asks_for_one(tmp_path: Path) -> None:
    data = data_set(tmp_path / "data", None, "images/1")
    (data / "a.yaml").write_text(f"val: images\n{NAMES}")
    assert Told().read(data).class_names == ("cat", "dog")
    (data / "b.yml").touch()
    with pytest.raises(DataError, match=r"expected one data.yaml, found a.yaml, b.yml"):
        Told().read(data)


def test_the_root_widens_what_may_be_read(tmp_path: Path) -> None:
    data = data_set(tmp_path / "data", f"val: ../images\n{NAMES}")
    data_set(tmp_path, None, "images/1")
    with pytest.raises(DataError, match="there are no images"):
        Told().read(data)
    (image,) = Told().read(data, root=tmp_path).images
    assert image.path == tmp_path / "images" / "1.jpg"
    assert len(image.boxes) == 1


def test_a_repeated_line_is_read_once_and_a_repeated_list_too(tmp_path: Path) -> None:
    data = data_set(tmp_path, f"val: [{', '.join(['val.txt'] * 1000)}]\n", "images/0")
    (data / "val.txt").write_text("images/0.jpg\n" * 1000)
    assert Told().names(data) == ["images/0.jpg"]


def test_the_lines_of_all_lists_count_together(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(yolo_folder, "MAX_IMAGES", 4)
    data = data_set(tmp_path, "val: [a.txt, b.txt]\n", "images/0")
    for name in ("a.txt", "b.txt"):
        (data / name).write_text("images/0.jpg\n" * 3)
    with pytest.raises(DataError, match=r"b\.txt: expected at most 4 lines in the lists of images, found 6"):
        Told().read(data)


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("MAX_IMAGES", "expected at most 4 images in a data set, found 5"),
        ("MAX_OBJECTS", "expected at most 4 objects in a data set, found 5"),
        ("MAX_LABEL_CHARACTERS", "expected at most 4 characters in label files, found 18"),
    ],
)
def test_a_folder_with_more_than_a_limit_is_refused(
    name: str, told: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(yolo_folder, name, 4)
    with pytest.raises(DataError, match=told):
        Told().read(data_set(tmp_path, None, *(f"images/{number}" for number in range(5))))


@pytest.mark.parametrize("text", [BOX, "\r"])
def test_a_label_file_of_too_many_lines_is_broken(text: str) -> None:
    with pytest.raises(DataError, match="more than 20000 lines"):
        parsed_labels(text * (MAX_LINES + 1), 1)


@pytest.mark.parametrize(
    ("text", "class_ids", "corners"),
    [
        pytest.param("", [], [], id="empty"),
        pytest.param("1 0.5 0.5 0.2 0.4", [1], [(40, 60, 60, 140)], id="box"),
        pytest.param("1.0 0.5 0.5 0.2 0.4\r\n", [1], [(40, 60, 60, 140)], id="class as a float"),
        pytest.param("0 0.1 0.1 0.3 0.1 0.2 0.4", [0], [(10, 20, 30, 80)], id="polygon"),
        pytest.param("0 0.05 0.5 0.2 1", [0], [(0, 0, 15, 200)], id="beyond the image"),
        pytest.param("0 0.5 0.5 1.00001 1", [0], [(0, 0, 100, 200)], id="rounded"),
        pytest.param(
            "0 0.5 0.5 0.2 0.4\n1 0.5 0.5 0.2 0.4\n0 0.5 0.5 0.2 0.4",
            [0, 1],
            [(40, 60, 60, 140)] * 2,
            id="equal lines",
        ),
    ],
)
def test_labels_are_boxes_in_pixels(
    text: str, class_ids: list[int], corners: list[tuple[int, int, int, int]]
) -> None:
    boxes = parsed_labels(text, 2).scaled((200, 100))
    assert boxes.class_ids.tolist() == class_ids
    np.testing.assert_allclose(boxes.xyxy, np.array(corners).reshape(-1, 4), atol=1e-9)


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        pytest.param("0 0.5 0.5 0.2", "found 4 fields", id="too few"),
        pytest.param("0 0.1 0.1 0.2 0.2 0.3 0.3 0.4", "found 8 fields", id="half a point"),
        pytest.param("2 0.5 0.5 0.2 0.2", "a class from 0 to 1, found 2", id="unknown class"),
        pytest.param("-1 0.5 0.5 0.2 0.2", "found -1", id="negative class"),
        pytest.param("0.5 0.5 0.5 0.2 0.2", "found 0.5", id="half a class"),
        pytest.param("1e400 0.5 0.5 0.2 0.2", "a class from 0 to 1, found 1e400", id="infinite class"),
        pytest.param("0 nan 0.5 0.2 0.2", "from 0 to 1, found nan", id="NaN"),
        pytest.param("0 1.5 0.5 0.2 0.2", "from 0 to 1, found 1.5", id="beyond 1"),
        pytest.param("0 0.5 -0.5 0.2 0.2", "from 0 to 1, found -0.5", id="below 0"),
        pytest.param("0 0.1 0.1 0.1 0.2 0.1 0.3", "no area", id="flat polygon"),
        pytest.param("9" * 300 + " 0.5 0.5 0.2 0.2", "found 999", id="long class"),
        pytest.param(
            "0 0.5 0.5 0.2 " + "x" * 300, "expected numbers: could not convert string", id="long name"
        ),
    ],
)
def test_a_broken_line_is_refused_with_its_number(line: str, reason: str) -> None:
    with pytest.raises(DataError) as refused:
        parsed_labels(f"0 0.5 0.5 0.2 0.2\n\n{line}\n", 2)
    assert str(refused.value).startswith("line 3: ")
    assert reason in str(refused.value)
    assert len(str(refused.value)) < 200


def test_the_number_of_objects_is_limited() -> None:
    lines = (f"0 0.5 0.5 0.2 {0.1 + number / 1e6}" for number in range(MAX_BOXES_PER_IMAGE + 1))
    with pytest.raises(DataError, match="the image: expected at most 10,000 objects, found 10,001"):
        parsed_labels("\n".join(lines), 1)


def test_a_file_that_is_no_text_is_refused_and_a_missing_one_has_no_labels(tmp_path: Path) -> None:
    assert label_text(tmp_path / "missing.txt") is None
    (tmp_path / "bytes.txt").write_bytes(b"\xff\xfe0 0.5")
    (tmp_path / "large.txt").write_text(" " * (MAX_LABEL_BYTES + 1))
    os.mkfifo(tmp_path / "pipe.txt")
    (tmp_path / "folder.txt").mkdir()
    for name in ("bytes.txt", "large.txt", "pipe.txt", "folder.txt"):
        with pytest.raises(DataError):
            label_text(tmp_path / name)
