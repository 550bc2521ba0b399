"""The command `evaluate` on the shapes: figures, files, comparison, thresholds, every kind of data set."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from pycocotools.coco import COCO
from pycocotools.cocoeval import COCOeval
from support.detected_offline import prepare_once
from support.evaluated_offline import (
    FAST,
    WEIGHTS,
    as_coco,
    evaluate,
    report_of,
    run,
    shapes,
)
from support.onnx_exports import small_export

from yolov5_lifecycle.detection.class_filter import selection_of
from yolov5_lifecycle.evaluation.matching import MIN_CONFIDENCE
from yolov5_lifecycle.images.image import ColourImage
from yolov5_lifecycle.settings.parameter_file import read_parameter_file
from yolov5_lifecycle.settings.settings import Settings
from yolov5_lifecycle.sources.scene import CLASS_NAMES

FILES = ["detections.json", "ground_truth.json", "report.json"]


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return shapes(tmp_path_factory.mktemp("data") / "shapes")


@pytest.fixture(scope="module")
def evaluated(data: Path) -> Path:
    """The files of an evaluation of the embedded model."""
    folder = data.parent / "evaluated"
    assert evaluate(data, "--output", str(folder)) == 0
    return folder


@pytest.mark.end_to_end
def test_the_embedded_model_finds_the_shapes(data: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert evaluate(data) == 0
    output, error = capsys.readouterr()
    assert error == ""
    lines = output.splitlines()
    head = next(number for number, line in enumerate(lines) if line.startswith("class "))
    assert " ".join(lines[head].split()) == "class images objects precision recall F1 mAP@50 mAP@50:95"
    cells = {line.split()[0]: line.split()[1:] for line in lines[head + 1 : head + 6]}
    assert list(cells) == ["all", *CLASS_NAMES]
    precision, recall, f1, ap50, ap50_95 = map(float, cells["all"][2:])
    assert precision > 0.9
    assert recall > 0.85
    assert f1 > 0.88
    assert ap50 > 0.93
    assert 0.7 < ap50_95 < ap50


@pytest.mark.long
def test_the_report_has_all_figures(evaluated: Path, data: Path) -> None:
    assert sorted(file.name for file in evaluated.iterdir()) == FILES
    report = report_of(evaluated)
    assert report["format"] == 1
    assert report["data"]["path"] == str(data)
    assert (report["data"]["images"], report["data"]["problems"]["counts"]) == (24, {})
    assert report["model"]["runtime"] == "onnxruntime"
    assert report["model"]["settings"]["image_size"] == 320
    assert 0 < report["model"]["speed_ms"]["median"] <= report["model"]["speed_ms"]["p95"]
    assert [row["name"] for row in report["classes"]] == list(CLASS_NAMES)
    for row in (report["all"], *report["classes"]):
        right, wrong, objects = row["right"], row["wrong"], row["objects"]
        assert row["missed"] == objects - right
        assert row["precision"] == pytest.approx(right / (right + wrong))
        assert row["recall"] == pytest.approx(right / objects)
        assert row["f1"] == pytest.approx(2 * right / (right + wrong + objects))
    matrix = np.array(report["confusion_matrix"]["counts"])
    assert matrix[:-1].sum() == report["data"]["objects"] == report["all"]["objects"]
    assert np.diagonal(matrix).sum() == report["all"]["right"]
    assert report["confusion_matrix"]["objects"] == [*CLASS_NAMES, "no object"]
    truth = COCO(str(evaluated / "ground_truth.json"))
    evaluation = COCOeval(truth, truth.loadRes(str(evaluated / "detections.json")), "bbox")
    evaluation.evaluate()
    evaluation.accumulate()
    evaluation.summarize()
    assert report["all"]["ap50_95"] == pytest.approx(evaluation.stats[0], abs=1e-6)
    assert report["all"]["ap50"] == pytest.approx(evaluation.stats[1], abs=1e-6)


def test_detections_above_the_threshold_are_those_of_the_node(evaluated: Path, data: Path) -> None:
    """Evaluating at a low threshold loses none of what the set threshold keeps, and adds none."""
    settings = Settings(weights=WEIGHTS, image_size=320, device="cpu", runtime="onnxruntime").model_copy(
        update={"confidence_threshold": MIN_CONFIDENCE}
    )
    detector = prepare_once(settings, ((480, 640),)).detector
    chosen = selection_of(Settings(confidence_threshold=0.25), detector.class_names)
    written = json.loads((evaluated / "detections.json").read_text())
    for number, path in enumerate(sorted((data / "images" / "val").iterdir()), start=1):
        found = detector.detect(ColourImage(cv2.imread(str(path)), "bgr"), chosen)
        scores = [one["score"] for one in written if one["image_id"] == number and one["score"] > 0.25]
        # The last layer computes other cells at once, which changes the last digit of a sum.
        assert sorted(scores) == pytest.approx(sorted(found.scores.tolist()), rel=1e-5)


def test_a_file_whose_name_is_not_utf_8_is_evaluated_and_reported(data: Path, tmp_path: Path) -> None:
    copy = tmp_path / "shapes"
    shutil.copytree(data, copy)
    image = min((copy / "images" / "val").iterdir())
    strange = os.fsdecode(b"a\xff")
    (copy / "labels" / "val" / image.name).with_suffix(".txt").rename(copy / "labels/val" / f"{strange}.txt")
    image.rename(image.with_stem(strange))
    assert evaluate(copy, "--output", str(tmp_path / "evaluated")) == 0
    assert report_of(tmp_path / "evaluated")["data"]["images"] == 24
    truth = json.loads((tmp_path / "evaluated" / "ground_truth.json").read_text())
    assert any(strange in one["file_name"] for one in truth["images"])


@pytest.mark.long
def test_coco_and_yolo_give_the_same_figures(evaluated: Path, data: Path, tmp_path: Path) -> None:
    assert evaluate(as_coco(data), "--output", str(tmp_path / "coco")) == 0
    of_yolo, of_coco = report_of(evaluated), report_of(tmp_path / "coco")
    assert of_coco["data"]["kind"] == "COCO"
    for row, other in zip(of_yolo["classes"], of_coco["classes"], strict=True):
        assert other == pytest.approx(row, abs=1e-4)


@pytest.mark.long
def test_another_image_size_is_compared_class_by_class(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["--compare", "image_size=128,confidence_threshold=0.3", "--output", str(tmp_path / "out")]
    assert evaluate(data, *words) == 0
    output = capsys.readouterr().out
    assert "OTHER has image_size=128\nOTHER has confidence_threshold=0.3\n" in output
    assert re.search(r"^speed   [0-9.]+ ms per image, OTHER [0-9.]+ ms$", output, re.MULTILINE)
    comparison = report_of(tmp_path / "out")["comparison"]
    assert comparison["changed"] == {"image_size": 128, "confidence_threshold": 0.3}
    together, *each = comparison["rows"]
    assert [row["name"] for row in each] == list(CLASS_NAMES)
    found = together["intervals"]["ap50_95"]
    assert found["verdict"] == "worse"
    assert found["difference_low"] < found["second"] - found["first"] < found["difference_high"] < 0
    written = json.loads((tmp_path / "out" / "detections_other.json").read_text())
    assert written


@pytest.mark.long
def test_printed_thresholds_are_parameters_that_do_what_they_say(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["--thresholds", "recall=0.9", "--node", "/robot/eye", "--output", str(tmp_path / "first")]
    assert evaluate(data, *words) == 0
    printed = capsys.readouterr().out
    file = tmp_path / "thresholds.yaml"
    file.write_text(printed[printed.index("# Chosen for") :])
    values = read_parameter_file(file)["/robot/eye"]
    assert [str(entry).partition(":")[0] for entry in list(values["class_thresholds"])] == list(CLASS_NAMES)  # type: ignore[arg-type]
    chosen = report_of(tmp_path / "first")["thresholds"]
    assert chosen["all"]["threshold"] == values["confidence_threshold"]
    again = ["--set", f"confidence_threshold={values['confidence_threshold']}"]
    assert evaluate(data, *again, "--output", str(tmp_path / "second")) == 0
    reached = report_of(tmp_path / "second")["all"]
    assert reached["recall"] >= 0.9
    assert reached["recall"] == pytest.approx(chosen["all"]["recall"])
    assert reached["precision"] == pytest.approx(chosen["all"]["precision"])


@pytest.mark.long
def test_classes_are_compared_by_name(data: Path, tmp_path: Path) -> None:
    """The data set has other ids than the model, and one more class."""
    changed = tmp_path / "changed"
    changed.mkdir()
    for number, file in enumerate(sorted((data / "labels" / "val").iterdir())):
        lines = [line.split(" ", 1) for line in file.read_text().splitlines()]
        text = "".join(f"{3 - int(class_id)} {rest}\n" for class_id, rest in lines)
        (changed / f"{number}.txt").write_text(text + "4 0.5 0.5 0.1 0.1\n")
        (changed / f"{number}.jpg").symlink_to(data / "images" / "val" / f"{file.stem}.jpg")
    (changed / "data.yaml").write_text("val: .\nnames: [star, triangle, square, circle, unicorn]\n")
    assert evaluate(changed, "--output", str(tmp_path / "out")) == 0
    report = report_of(tmp_path / "out")
    assert [row["name"] for row in report["classes"]] == ["star", "triangle", "square", "circle"]
    assert report["data"]["classes_left_out"] == ["unicorn"]
    assert report["all"]["ap50"] > 0.93


@pytest.mark.long
@pytest.mark.parametrize(("module", "status"), [("rosbags", 0), ("pycocotools", 1)])
def test_a_missing_package_is_named_with_the_remedy_where_it_is_needed(
    module: str, status: int, data: Path, tmp_path: Path
) -> None:
    program = (
        f"import sys; sys.modules[{module!r}] = None; "
        "from yolov5_lifecycle.commands.entry_points import evaluate; evaluate()"
    )
    command = [sys.executable, "-c", program, WEIGHTS, str(data), *FAST]
    ended = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert ended.returncode == status
    assert (f"-m pip install {module}" in ended.stderr) is (status == 1)
    assert list(tmp_path.iterdir()) == []


def test_an_export_of_a_fixed_size_is_evaluated_with_that_unless_another_is_given(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    export = tmp_path / "best.onnx"
    export.write_bytes(small_export(size_hw=(64, 96)))
    words = [str(export), str(data / "images"), "--set", "cameras=[front]", "--camera", "front"]
    assert run(words) == 0
    assert ", image size 96\n" in capsys.readouterr().out
    assert run([*words, "--set", "image_size=640"]) == 1
    assert "takes images of 96x64 only. Set image_size to 96." in capsys.readouterr().err
