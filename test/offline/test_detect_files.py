"""Images and videos through the detector: lines of JSON and annotated files."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from pathlib import Path

import cv2
import numpy as np
import pytest
from pycocotools import mask as coco
from rosbags.rosbag2 import Reader
from sensor_msgs.msg import Image
from support.compressed_files import claiming_too_much
from support.detected_offline import SET_MODEL, published, run
from support.detector_process import Sighting
from support.recorded_scene import COUNT, SIZE_HW, images, shown, video
from support.reference_masks import whole_mask
from support.refusals import Refused
from support.segmented_offline import SET_MODEL as SET_SEGMENTING
from support.segmented_offline import segment, segmented

from yolov5_lifecycle.images.image import ColourImage
from yolov5_lifecycle.process.standard_streams import EXIT_NOBODY_READS
from yolov5_lifecycle.ros.child_process import entry_point


def test_images_become_lines_and_annotated_images(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder, drawn = images(tmp_path / "shots"), tmp_path / "drawn"
    (folder / "1.png").write_bytes(b"no image")
    (folder / "3.png").write_bytes(claiming_too_much())
    (folder / "notes.txt").write_text("no image either")
    assert run([str(folder), "--annotated", str(drawn), *SET_MODEL]) == 0
    output, error = capsys.readouterr()
    lines = [json.loads(line) for line in output.splitlines()]
    assert [line["file"] for line in lines] == [str(folder / "0.png"), str(folder / "2.png")]
    assert [(line["height"], line["width"]) for line in lines] == [SIZE_HW] * 2
    found = published(Image(height=240, width=320, encoding="rgb8", step=960, data=shown(0)[0].tobytes()))[0]
    seen = Sighting.of(found)
    assert [one["class_name"] for one in lines[0]["detections"]] == list(seen.class_names)
    assert [one["score"] for one in lines[0]["detections"]] == list(seen.scores)
    boxes_xyxy = [one["box_xyxy"] for one in lines[0]["detections"]]
    np.testing.assert_allclose(boxes_xyxy, seen.boxes_xyxy, atol=1e-4)
    assert f"detect_bag: {folder / '1.png'}: rejected: " in error
    assert f"detect_bag: {folder / '3.png'}: rejected: " in error
    assert "images    4: 2 detected, 2 rejected, 0 failed\n" in error
    assert sorted(file.name for file in drawn.iterdir()) == ["0.png", "2.png"]
    assert cv2.imread(str(drawn / "0.png")).shape == (*SIZE_HW, 3)


@pytest.mark.end_to_end
def test_the_command_reads_a_recording_and_writes_one(drive: Path, tmp_path: Path) -> None:
    words = [entry_point("detect_bag"), str(drive), "--output", str(tmp_path / "found"), *SET_MODEL]
    ended = subprocess.run(words, capture_output=True, text=True, check=False)
    assert (ended.returncode, ended.stdout) == (0, "")
    assert f"images    {COUNT}: {COUNT} detected, 0 rejected, 0 failed\n" in ended.stderr
    with Reader(tmp_path / "found") as reader:
        assert reader.topics["/yolov5/detections"].msgcount == COUNT


@pytest.mark.long
def test_the_command_ends_quietly_when_nobody_reads_its_lines(tmp_path: Path) -> None:
    reader, writer = os.pipe()
    os.close(reader)
    command = [entry_point("detect_bag"), str(images(tmp_path / "shots")), *SET_MODEL]
    ended = subprocess.run(command, stdout=writer, stderr=subprocess.PIPE, text=True, check=False)
    os.close(writer)
    assert ended.returncode == EXIT_NOBODY_READS
    assert "Broken pipe" not in ended.stderr


def test_a_video_becomes_lines_in_a_file_and_an_annotated_video(tmp_path: Path) -> None:
    source, lines, drawn = video(tmp_path / "drive.avi"), tmp_path / "found.jsonl", tmp_path / "drawn.mp4"
    words = [str(source), "--output", str(lines), "--annotated", str(drawn), *SET_MODEL]
    assert run([*words, "--set", "classes=[star]", "-p", "classes:=[circle]"]) == 0
    found = [json.loads(line) for line in lines.read_text().splitlines()]
    assert [line["frame"] for line in found] == list(range(COUNT))
    assert {one["class_name"] for line in found for one in line["detections"]} == {"circle"}
    capture = cv2.VideoCapture(str(drawn))
    assert capture.get(cv2.CAP_PROP_FPS) == pytest.approx(12.5)
    assert [capture.read()[0] for _ in range(COUNT + 1)] == [True] * COUNT + [False]
    capture.release()


def test_a_parameter_file_with_a_tracker_serves_image_files_too(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "parameters.yaml"
    file.write_text("/**:\n  ros__parameters:\n    tracker: bytetrack\n")
    assert run([str(images(tmp_path / "shots")), "--params-file", str(file), *SET_MODEL]) == 0
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert len(lines) == COUNT
    assert not any("id" in one for line in lines for one in line["detections"])


def test_lines_have_the_whole_mask_of_each_object(tmp_path: Path) -> None:
    output = tmp_path / "found.jsonl"
    assert segment([str(images(tmp_path / "shots")), "--output", str(output), *SET_SEGMENTING]) == 0
    for number, line in enumerate(output.read_text().splitlines()):
        found = segmented(ColourImage(shown(number)[0], "rgb"))
        assert found.masks is not None
        expected = np.stack([whole_mask(found.masks, *one) for one in enumerate(found.boxes_xyxy)])
        assert expected.sum(axis=0).max() > 1  # they overlap
        for one, mask in zip(json.loads(line)["detections"], expected, strict=True):
            assert list(one) == ["class_name", "score", "box_xyxy", "mask"]
            theirs = coco.encode(np.asfortranarray(mask, np.uint8))
            assert one["mask"] == {"size": [*SIZE_HW], "counts": theirs["counts"].decode()}


def test_an_image_may_be_called_like_a_camera(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    video(tmp_path / "0.avi").rename("0")
    assert run(["0", "--output", "found.jsonl", *SET_MODEL]) == 0
    assert len(Path("found.jsonl").read_text().splitlines()) == COUNT


@pytest.mark.parametrize(
    ("source", "words", "told"),
    [
        pytest.param("empty.mp4", [], "has no images", id="empty folder that is called like a video"),
        pytest.param("missing", [], "file or folder not found", id="missing"),
        pytest.param("shots/0.png", ["--output", "lines.jsonl"], "exists and is not", id="lines exist"),
        pytest.param("shots", ["--output", "x.txt"], "expected a name that ends in .jsonl", id="format"),
        pytest.param("shots", ["--annotated", "empty.mp4"], "exists and is not", id="drawings exist"),
        pytest.param("shots/0.png", ["--annotated", "x.foo"], "ends in .png or .jpg", id="image suffix"),
        pytest.param("drive.avi", ["--annotated", "x.foo"], "ends in .mp4", id="video suffix"),
        # OpenCV crashes on these names.
        pytest.param(
            "bad\udcff/0.avi",
            [],
            "bad?/0.avi: the path or address of a source must be UTF-8",
            id="video path",
        ),
        pytest.param(
            "drive.avi",
            ["--annotated", "\udcff.mp4"],
            "?.mp4: the path of an annotated video must be UTF-8: choose another --annotated",
            id="annotated video path",
        ),
        pytest.param("shots/0.png", ["--annotated", "x.\udcff"], "ends in .png or .jpg", id="odd suffix"),
    ],
)
def test_an_error_with_files_says_why_and_leaves_nothing_behind(
    source: str, words: list[str], told: str, tmp_path: Path, refused: Refused
) -> None:
    images(tmp_path / "shots")
    video(tmp_path / "drive.avi")
    Path("bad\udcff").mkdir()
    shutil.copy("drive.avi", "bad\udcff/0.avi")
    Path("empty.mp4").mkdir()
    Path("lines.jsonl").touch()
    assert told in refused(run, source, *SET_MODEL, *words)


def test_images_may_have_any_name(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder, drawn = images(tmp_path / "shots"), tmp_path / "drawn\udcff"
    (folder / "0.png").rename(folder / "\udcff.png")
    assert run([str(folder), "--annotated", str(drawn), *SET_MODEL]) == 0
    lines = [json.loads(line) for line in capsys.readouterr()[0].splitlines()]
    assert str(folder / "\udcff.png") in [line["file"] for line in lines]
    assert sorted(file.name for file in drawn.iterdir()) == ["1.png", "2.png", "\udcff.png"]


def test_what_counts_is_the_same_as_in_the_node_and_drawn(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, drawn = images(tmp_path / "shots"), tmp_path / "drawn"
    left, thresholds = "0,0 0.5,0 0.5,1 0,1", "class_thresholds=['star: 1.0']"
    words = [str(folder), "--annotated", str(drawn), *SET_MODEL, "--set", thresholds]
    assert run([*words, "--set", f"regions=['{left}']", "-p", "region_anchor:=foot"]) == 0
    lines = [json.loads(line) for line in capsys.readouterr()[0].splitlines()]
    found = [one for line in lines for one in line["detections"]]
    assert found
    for one in found:
        assert one["box_xyxy"][0] + one["box_xyxy"][2] <= SIZE_HW[1]
        assert one["class_name"] != "star"
    line_x = cv2.imread(str(drawn / "0.png"))[:, SIZE_HW[1] // 2].astype(int)
    source_x = cv2.imread(str(folder / "0.png"))[:, SIZE_HW[1] // 2].astype(int)
    assert (np.abs(line_x - source_x).max(axis=1) > 0).mean() > 0.9
