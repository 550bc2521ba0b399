"""Labels in YOLO format: boxes and polygons, and what is refused."""

from __future__ import annotations

import codecs
import os
from pathlib import Path

import numpy as np
import pytest

from yolov5_lifecycle.evaluation.ground_truth import MAX_BOXES_PER_IMAGE, DataError
from yolov5_lifecycle.evaluation.yolo_labels import label_text, parsed_labels


@pytest.mark.parametrize(
    ("text", "class_ids", "corners"),
    [
        pytest.param("", [], [], id="empty"),
        pytest.param("\n \n", [], [], id="blank lines"),
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
    boxes = parsed_labels(text, 2).in_pixels((200, 100))
    assert boxes.class_ids.tolist() == class_ids
    np.testing.assert_allclose(boxes.xyxy, np.array(corners).reshape(-1, 4), atol=1e-9)


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        pytest.param("0 0.5 0.5 0.2", "found 4 fields", id="too few"),
        pytest.param("0 0.5 0.5 0.2 0.2 0.9", "found 6 fields", id="with a score"),
        pytest.param("0 0.1 0.1 0.2 0.2 0.3 0.3 0.4", "found 8 fields", id="half a point"),
        pytest.param("2 0.5 0.5 0.2 0.2", "a class from 0 to 1, found 2", id="unknown class"),
        pytest.param("-1 0.5 0.5 0.2 0.2", "found -1", id="negative class"),
        pytest.param("0.5 0.5 0.5 0.2 0.2", "found 0.5", id="half a class"),
        pytest.param("1e400 0.5 0.5 0.2 0.2", "expected numbers", id="infinite class"),
        pytest.param("cat 0.5 0.5 0.2 0.2", "expected numbers, found 'cat'", id="name"),
        pytest.param("0 nan 0.5 0.2 0.2", "expected numbers, found 'nan'", id="NaN"),
        pytest.param("0 inf 0.5 0.2 0.2", "expected numbers", id="infinity"),
        pytest.param("0 1.5 0.5 0.2 0.2", "from 0 to 1, found 1.5", id="beyond 1"),
        pytest.param("0 0.5 -0.5 0.2 0.2", "from 0 to 1, found -0.5", id="below 0"),
        pytest.param("0 320 240 64 48", "from 0 to 1, found 320", id="pixels"),
        pytest.param("0 0.5 0.5 0 0.2", "no area", id="no width"),
        pytest.param("0 0.1 0.1 0.1 0.2 0.1 0.3", "no area", id="flat polygon"),
    ],
)
def test_a_broken_line_is_refused_with_its_number(line: str, reason: str) -> None:
    with pytest.raises(DataError) as refused:
        parsed_labels(f"0 0.5 0.5 0.2 0.2\n\n{line}\n", 2)
    assert str(refused.value).startswith("line 3: ")
    assert reason in str(refused.value)


def test_the_number_of_objects_is_limited() -> None:
    lines = (f"0 0.5 0.5 0.2 {0.1 + number / 1e6}" for number in range(MAX_BOXES_PER_IMAGE + 1))
    with pytest.raises(DataError, match="more than 10000 objects"):
        parsed_labels("\n".join(lines), 1)


def test_a_file_that_is_no_text_is_refused_and_a_missing_one_has_no_labels(tmp_path: Path) -> None:
    assert label_text(tmp_path / "missing.txt") is None
    (tmp_path / "bytes.txt").write_bytes(b"\xff\xfe0 0.5")
    os.mkfifo(tmp_path / "pipe.txt")
    (tmp_path / "folder.txt").mkdir()
    for name in ("bytes.txt", "pipe.txt", "folder.txt"):
        with pytest.raises(DataError):
            label_text(tmp_path / name)


@pytest.mark.parametrize(
    "content",
    [
        pytest.param(codecs.BOM_UTF8 + b"1 0.5", id="UTF-8"),
        pytest.param(b"1 " + codecs.BOM_UTF8 + b"0.5", id="joined files"),
        pytest.param(codecs.BOM_UTF16_LE + "1 0.5".encode("utf-16-le"), id="UTF-16"),
        pytest.param(codecs.BOM_UTF16_BE + "1 0.5".encode("utf-16-be"), id="big-endian UTF-16"),
    ],
)
def test_a_byte_order_mark_is_no_part_of_a_label(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "1.txt").write_bytes(content)
    assert label_text(tmp_path / "1.txt") == "1 0.5"
