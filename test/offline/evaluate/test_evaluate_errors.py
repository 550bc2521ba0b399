"""Errors of `evaluate` for unusable data, settings or models; nothing half-written is left behind."""

from __future__ import annotations

import json
import os
import resource
from collections.abc import Callable
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
from support.compressed_files import claiming_too_much
from support.detected_offline import prepare_raising
from support.evaluated_offline import FAST, WEIGHTS, as_coco, evaluate, report_of, run, shapes
from support.recorded_scene import raw, record
from support.refusals import Refused

from yolov5_lifecycle.offline.evaluate import evaluating
from yolov5_lifecycle.offline.evaluate.command import main
from yolov5_lifecycle.runtimes.runtime import InferenceError


@pytest.fixture
def data(tmp_path: Path) -> Path:
    return shapes(tmp_path / "shapes", images=6)


@pytest.mark.long
def test_broken_images_and_labels_are_listed_counted_and_left_out(
    data: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    images, labels = data / "images" / "val", data / "labels" / "val"
    (images / "0000.jpg").write_bytes(b"no image")
    (images / "0001.jpg").write_bytes(claiming_too_much())
    (labels / "0002.txt").write_text("0 nan 0.5 0.1 0.1\n")
    (labels / "0003.txt").write_bytes(os.urandom(1000) + b"\xff")
    (images / "0004.jpg").unlink()
    os.mkfifo(images / "0004.jpg")
    (images / "list.txt").write_text("no image either")
    (labels / "0005.txt").write_text("0 0.5 0.5 0.1 0.1\n")
    words = ["--output", str(data.parent / "out"), "--compare", "confidence_threshold=0.5"]
    assert evaluate(data, *words) == 0
    output, error = capsys.readouterr()
    report = report_of(data.parent / "out")
    counts = report["data"]["problems"]["counts"]
    assert counts == {"broken labels": 2, "unusable images": 3}
    assert report["data"]["images"] == 1
    assert [row["recall"] is None for row in report["classes"]] == [False, True, True, True]
    assert [line.removeprefix("evaluate: ") for line in error.splitlines()] == report["data"]["problems"][
        "first"
    ]
    assert "not evaluated: 2 broken labels, 3 unusable images\n" in output


def test_an_image_of_another_size_than_its_labels_is_left_out(
    data: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cv2.imwrite(str(data / "images" / "val" / "0003.jpg"), np.zeros((100, 100, 3), np.uint8))
    assert evaluate(as_coco(data)) == 0
    assert "the labels are for an image of 320 x 256 pixels, found 100 x 100" in capsys.readouterr().err


def test_figures_that_cannot_be_written_are_printed(data: Path, capsys: pytest.CaptureFixture[str]) -> None:
    _, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100, hard))
    try:
        code = evaluate(data, "--output", str(data.parent / "out"))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (hard, hard))
    output, error = capsys.readouterr()
    assert code == 1
    assert "mAP" in output
    assert "File too large" in error
    assert not (data.parent / "out").exists()


def a_text(folder: Path) -> Path:
    (folder / "notes.txt").touch()
    return folder / "notes.txt"


def crowds_only(folder: Path) -> Path:
    source = as_coco(shapes(folder / "shapes", images=1))
    content = json.loads(source.read_text())
    content["annotations"] = [one | {"iscrowd": 1} for one in content["annotations"]]
    source.write_text(json.dumps(content))
    return source


def a_recording(folder: Path) -> Path:
    return record(folder / "drive", [raw(0)])


@pytest.mark.long
@pytest.mark.parametrize(
    ("make", "reason"),
    [
        pytest.param(lambda folder: folder / "missing", "file or folder not found", id="missing"),
        pytest.param(a_text, "expected a folder with images/ and labels/", id="a text"),
        pytest.param(crowds_only, "images has an object of the classes", id="crowds only"),
        pytest.param(a_recording, "found a recording: play it to a detector with `collect", id="recording"),
    ],
)
def test_data_of_which_nothing_can_be_used_ends_it_with_a_reason(
    make: Callable[[Path], Path], reason: str, tmp_path: Path, refused: Refused
) -> None:
    assert reason in refused(run, WEIGHTS, make(tmp_path), *FAST, "--output", "out")


@pytest.mark.long
@pytest.mark.parametrize(
    ("words", "reason"),
    [
        pytest.param(["--output", "shapes"], "exists and is not replaced", id="output exists"),
        pytest.param(["--set", "classes=[circel]"], "classes: 'circel' is not", id="class"),
        pytest.param(["--compare", "imagesize=320"], "Did you mean 'image_size'?", id="compared name"),
        pytest.param(["--compare", "missing.pt"], "missing.pt", id="compared weights"),
        pytest.param(
            ["--compare", "classes=[star],agnostic_nms=true", "--set", "classes=[circle]"],
            "none that the settings select",
            id="no class in common",
        ),
        pytest.param(["--split", "train"], "there is no entry 'train', only: val.", id="split"),
    ],
)
def test_a_wrong_argument_ends_it_with_a_reason(
    words: list[str], reason: str, data: Path, refused: Refused
) -> None:
    assert reason in refused(run, WEIGHTS, data, *FAST, *words)


@pytest.mark.long
@pytest.mark.parametrize(
    ("words", "reason"),
    [
        pytest.param(["--thresholds", "best"], "expected f1, recall=0.9 or precision=0.95", id="goal"),
        pytest.param(["--split", "mine"], "invalid choice: 'mine'", id="split"),
        pytest.param(
            ["--compare", "image_size=320,min_box_size=0.5"], "min_box_size has no effect", id="compared size"
        ),
        pytest.param(
            ["--set", "weights=a.pt", "-p", "tracker:=bytetrack"],
            "no effect: images are evaluated one by one; the setting weights has no effect: the model is "
            "WEIGHTS",
            id="several",
        ),
    ],
)
def test_a_wrong_command_line_ends_it_with_2(
    words: list[str], reason: str, data: Path, refused: Refused
) -> None:
    assert reason in refused.in_a_line(run, WEIGHTS, data, *FAST, *words, code=2)


def test_an_option_of_other_data_ends_it_with_2(data: Path, refused: Refused) -> None:
    told = refused(run, WEIGHTS, as_coco(data), "--split", "val", code=2)
    assert "--split does not apply to " in told


def test_inference_that_fails_again_and_again_ends_it(data: Path, refused: Refused) -> None:
    raising = partial(main, prepare=prepare_raising(InferenceError("out of memory")))
    told = refused(raising, WEIGHTS, data, "--set", "max_consecutive_failures=2", "--output", "out")
    assert "evaluate: stopped after 2 consecutive failed images: out of memory\n" in told


def test_an_interrupt_leaves_nothing_half_written(data: Path, refused: Refused) -> None:
    raising = partial(main, prepare=prepare_raising(KeyboardInterrupt()))
    told = refused(raising, WEIGHTS, data, "--output", "out", code=130)
    assert told == "evaluate: interrupted; unfinished output was removed\n"


@pytest.mark.long
def test_the_name_of_a_weights_file_is_not_interpreted(data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(data.parent)
    name = "[best #2: 3].safetensors"
    Path(name).symlink_to(WEIGHTS)
    assert run([name, str(data), *FAST, "--compare", name]) == 0


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("MAX_CLASSES_IN_IMAGES", "expected at most 2 classes x images, found 24"),
        ("MAX_FOUND", "expected at most 2 detections, found"),
    ],
)
def test_what_pycocotools_would_have_to_hold_is_limited(
    name: str, told: str, data: Path, monkeypatch: pytest.MonkeyPatch, refused: Refused
) -> None:
    monkeypatch.setattr(evaluating, name, 2)
    assert told in refused(run, WEIGHTS, data, *FAST)
