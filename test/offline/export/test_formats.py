"""Exported detections: each format has those of the lines of JSON, whatever the source."""

from __future__ import annotations

import csv
import json
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple
from unittest.mock import Mock

import cv2
import numpy as np
import pytest
import yaml
from pycocotools import mask
from pycocotools.coco import COCO
from support.detected_offline import SET_MODEL, run
from support.recorded_scene import COUNT, SIZE_HW, images, raw, record, stamp_s, video
from support.refusals import Refused
from support.segmented_offline import SET_MODEL as SET_SEGMENTING
from support.segmented_offline import segment

from yolov5_lifecycle.evaluation.ground_truth import Problems
from yolov5_lifecycle.evaluation.yolo_folder import read_yolo_folder
from yolov5_lifecycle.offline.export.formats import COLUMNS
from yolov5_lifecycle.offline.terminal import Terminal
from yolov5_lifecycle.sources.scene import CLASS_NAMES

HEIGHT, WIDTH = SIZE_HW


class Row(NamedTuple):
    """A detection as a format has it: the image by its number in the source, and what else it can hold."""

    image: int
    class_name: str
    score: float
    box_xyxy: tuple[float, ...]


def of_jsonl(path: Path) -> Iterator[Row]:
    for number, line in enumerate(path.read_text().splitlines()):
        for one in json.loads(line)["detections"]:
            yield Row(number, one["class_name"], one["score"], tuple(one["box_xyxy"]))


def of_coco(path: Path) -> Iterator[Row]:
    content = json.loads(path.read_text())
    names = {one["id"]: one["name"] for one in content["categories"]}
    numbers = {one["id"]: number for number, one in enumerate(content["images"])}
    for one in content["annotations"]:
        x, y, width, height = one["bbox"]
        corners = (x, y, x + width, y + height)
        yield Row(numbers[one["image_id"]], names[one["category_id"]], one["score"], corners)


def of_csv(path: Path) -> Iterator[Row]:
    rows = list(csv.DictReader(path.read_text().splitlines()))
    identity = next(iter(rows[0]))
    numbers = {value: number for number, value in enumerate(dict.fromkeys(row[identity] for row in rows))}
    for row in rows:
        assert CLASS_NAMES[int(row["class_id"])] == row["class_name"]
        box_xyxy = tuple(float(row[name]) for name in ("x_min", "y_min", "x_max", "y_max"))
        yield Row(numbers[row[identity]], row["class_name"], float(row["score"]), box_xyxy)


def of_yolo(path: Path) -> Iterator[Row]:
    names = yaml.safe_load((path / "data.yaml").read_text())["names"]
    for number, file in enumerate(sorted((path / "labels").iterdir())):
        for line in file.read_text().splitlines():
            class_id, x, y, width, height = map(float, line.split())
            box = (x - width / 2, y - height / 2, x + width / 2, y + height / 2)
            corners = tuple(np.multiply(box, (WIDTH, HEIGHT, WIDTH, HEIGHT)).tolist())
            yield Row(number, names[int(class_id)], np.nan, corners)


READ = {".jsonl": of_jsonl, ".json": of_coco, ".csv": of_csv, ".yolo": of_yolo}


SOURCES: dict[str, Callable[[Path], Path]] = {
    "images": lambda folder: images(folder / "shots"),
    "video": lambda folder: video(folder / "drive.avi"),
    "recording": lambda folder: record(folder / "drive"),
}
each_source = pytest.mark.parametrize("source", SOURCES.values(), ids=SOURCES)


@pytest.mark.long
@each_source
@pytest.mark.parametrize("suffix", READ)
def test_a_format_has_the_detections_of_the_lines(
    suffix: str, source: Callable[[Path], Path], tmp_path: Path
) -> None:
    path, lines, output = source(tmp_path), tmp_path / "lines.jsonl", tmp_path / f"found{suffix}"
    assert run([str(path), "--output", str(lines), *SET_MODEL]) == 0
    assert run([str(path), "--output", str(output), *SET_MODEL]) == 0
    expected, found = list(of_jsonl(lines)), list(READ[suffix](output))
    assert len({row.image for row in expected}) == COUNT
    assert [row[:2] for row in found] == [row[:2] for row in expected]
    limits = (WIDTH, HEIGHT, WIDTH, HEIGHT)
    for one, other in zip(found, expected, strict=True):
        corners = np.clip(other.box_xyxy, 0, limits) if suffix == ".yolo" else other.box_xyxy
        np.testing.assert_allclose(one.box_xyxy, corners, atol=1e-3)
        assert np.isnan(one.score) or one.score == pytest.approx(other.score, abs=1e-6)
    assert sorted(one.name for one in tmp_path.iterdir()) == sorted([path.name, lines.name, output.name])


def test_tracks_have_their_ids_in_every_format_but_yolo(tmp_path: Path) -> None:
    source = video(tmp_path / "drive.avi")
    for suffix in (".jsonl", ".json", ".csv"):
        words = ["--output", str(tmp_path / f"found{suffix}"), "--track", *SET_MODEL]
        assert run([str(source), *words]) == 0
    lines = (tmp_path / "found.jsonl").read_text().splitlines()
    of_images = [[one["id"] for one in json.loads(line)["detections"]] for line in lines]
    assert {*of_images[0]} == {""}
    assert "" not in of_images[-1]
    assert len({*of_images[-1]}) == len(of_images[-1]) > 0
    ids = [one for of_image in of_images for one in of_image]
    content = json.loads((tmp_path / "found.json").read_text())
    assert [one["track_id"] for one in content["annotations"]] == ids
    table = csv.DictReader((tmp_path / "found.csv").read_text().splitlines())
    assert [one["id"] for one in table] == ids


def test_pycocotools_reads_the_file_and_its_masks(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source = images(tmp_path / "shots")
    for suffix in (".json", ".jsonl"):
        words = ["--output", str(tmp_path / f"found{suffix}"), *SET_SEGMENTING]
        assert segment([str(source), *words]) == 0
    coco = COCO(str(tmp_path / "found.json"))
    assert [image["file_name"] for image in coco.loadImgs(coco.getImgIds())] == ["0.png", "1.png", "2.png"]
    lines = (tmp_path / "found.jsonl").read_text().splitlines()
    masks = [one["mask"] for line in lines for one in json.loads(line)["detections"]]
    annotations = coco.loadAnns(coco.getAnnIds())
    assert [one["segmentation"] for one in annotations] == masks
    assert [one["area"] for one in annotations] == [mask.area(coco.annToRLE(one)) for one in annotations]
    assert min(one["id"] for one in annotations) == 1
    words = ["--output", str(tmp_path / "without.json"), "--no-masks", *SET_SEGMENTING]
    assert segment([str(source), *words]) == 0
    assert "counts" not in (tmp_path / "without.json").read_text()


def test_yolo_text_becomes_a_data_set_beside_its_images(tmp_path: Path) -> None:
    source, output = images(tmp_path / "shots"), tmp_path / "found.yolo"
    cv2.imwrite(str(source / "empty.png"), np.zeros((48, 64, 3), np.uint8))
    assert run([str(source), "--output", str(output), *SET_MODEL]) == 0
    assert (output / "labels" / "empty.txt").read_bytes() == b""
    shutil.copytree(source, output / "images")
    data = read_yolo_folder(output / "data.yaml", Problems(pytest.fail))
    assert data.class_names == CLASS_NAMES
    assert len(data.images) == COUNT + 1


@pytest.mark.parametrize(("name", "read"), [("found", of_jsonl), ("found.CSV", of_csv)])
def test_the_default_are_lines_and_the_case_of_a_suffix_makes_no_difference(
    name: str, read: Callable[[Path], Iterator[Row]], tmp_path: Path
) -> None:
    assert run([str(images(tmp_path / "shots")), "--output", str(tmp_path / name), *SET_MODEL]) == 0
    assert len(list(read(tmp_path / name))) > COUNT


@pytest.mark.parametrize(
    ("suffix", "source"),
    [
        *(("", "recording"), (".jsonl", "video"), (".json", "images")),
        *((".csv", "recording"), (".yolo", "images")),
    ],
)
def test_an_interrupted_export_leaves_nothing(
    suffix: str, source: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, refused: Refused
) -> None:
    path = SOURCES[source](tmp_path)
    monkeypatch.setattr(Terminal, "progress", Mock(side_effect=[None, KeyboardInterrupt]))
    told = refused(run, path, "--output", f"found{suffix}", "--crops", *SET_MODEL, code=130)
    assert told == "detect_bag: interrupted; unfinished output was removed\n"


def test_two_images_of_one_name_are_refused_in_yolo_text(tmp_path: Path, refused: Refused) -> None:
    source = images(tmp_path / "shots")
    shutil.copy(source / "1.png", source / "1.bmp")
    told = refused(run, source, "--output", "found.yolo", *SET_MODEL)
    assert "1: 2 images have this name, but YOLO text has one file for each" in told


def test_images_of_one_stamp_are_told_apart(tmp_path: Path) -> None:
    taken = [raw(number) for number in (0, 1, 2, 0)]
    for number in (0, 1, 3):
        taken[number].header.stamp.sec = taken[number].header.stamp.nanosec = 0
    source = record(tmp_path / "drive", taken)
    for suffix in READ:
        assert run([str(source), "--output", str(tmp_path / f"found{suffix}"), *SET_MODEL]) == 0
    identities = [(0, 0), (0, 1), (stamp_s(2) * 10**9 + 9, 2), (0, 3)]
    lines = [json.loads(line) for line in (tmp_path / "found.jsonl").read_text().splitlines()]
    assert [(line["stamp_ns"], line["frame"]) for line in lines] == identities
    header, *rows = csv.reader((tmp_path / "found.csv").read_text().splitlines())
    assert header == ["stamp_ns", "frame", *COLUMNS]
    assert {(int(row[0]), int(row[1])) for row in rows} == {*identities}
    stamps = ["0_000000000", "0_000000000", "1700000002_000000009", "0_000000000"]
    told = [f"{stamp}_frame_{number:06}" for number, stamp in enumerate(stamps)]
    assert sorted(file.stem for file in (tmp_path / "found.yolo" / "labels").iterdir()) == sorted(told)
    content = json.loads((tmp_path / "found.json").read_text())
    assert [one["file_name"] for one in content["images"]] == told
    assert [one["frame"] for one in content["images"]] == [0, 1, 2, 3]


def test_a_file_name_that_is_no_text_is_escaped(tmp_path: Path) -> None:
    source, output = images(tmp_path / "shots"), tmp_path / "found.csv"
    (source / "0.png").rename(source / "\udcff.png")
    assert run([str(source), "--output", str(output), *SET_MODEL]) == 0
    assert len({row.image for row in of_csv(output)}) == COUNT
