"""Calibration on labelled images: which of them are evaluated, and how much mAP int8 loses there."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from support.evaluated_offline import WEIGHTS, as_coco, evaluate, report_of, shapes

from yolov5_lifecycle import load_model
from yolov5_lifecycle.checkpoints.locate import load_weights
from yolov5_lifecycle.detection.detector import Detector
from yolov5_lifecycle.evaluation.ground_truth import DataError, LabelledFolder, Problems
from yolov5_lifecycle.offline.calibrate.calibration_images import CalibrationData, read_calibration_data
from yolov5_lifecycle.offline.calibrate.command import main
from yolov5_lifecycle.offline.calibrate.measuring import map_loss
from yolov5_lifecycle.offline.evaluate.arguments import DataOptions
from yolov5_lifecycle.offline.evaluate.labelled_data import has_labels, labelled_data
from yolov5_lifecycle.offline.image_files import ImageFile
from yolov5_lifecycle.quantization.calibration_file import read_calibration
from yolov5_lifecycle.runtimes.registry import installed_runtimes
from yolov5_lifecycle.settings.settings import validated

IMAGES = 24
QUIET: Any = SimpleNamespace(lost=pytest.fail, progress=lambda _: None)

needs_openvino = pytest.mark.skipif(
    "openvino" not in installed_runtimes(), reason="no openvino: make install"
)


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return shapes(tmp_path_factory.mktemp("data") / "shapes", IMAGES)


@pytest.fixture
def copy(data: Path, tmp_path: Path) -> Path:
    """The data set, to be changed."""
    return Path(shutil.copytree(data, tmp_path / "shapes"))


@pytest.fixture(scope="module")
def detector() -> Detector:
    return load_model(Path(WEIGHTS), runtime="onnxruntime", device="cpu", precision="fp32", image_size=320)


@pytest.mark.parametrize(
    ("folders", "source", "expected"),
    [
        ("", "data.yaml", True),
        ("", "truth.json", True),
        ("images labels", "", True),
        ("images", "", False),
        ("labels", "", False),
        ("images labels drive.mcap", "", False),
        ("", "drive.mp4", False),
    ],
)
def test_data_sets_have_labels(folders: str, source: str, expected: bool, tmp_path: Path) -> None:
    for name in folders.split():
        (tmp_path / name).mkdir()
    assert has_labels(tmp_path / source) is expected


def read(path: Path, count: int = IMAGES, options: DataOptions | None = None) -> CalibrationData:
    return read_calibration_data(
        path,
        options or DataOptions(),
        count,
        lambda image: image,
        problems=Problems(pytest.fail),
        lost=lambda *_: None,
        seen=lambda _: None,
    )


def names(data: LabelledFolder) -> list[str]:
    return [image.path.stem for image in data.images]


def test_images_whose_ranges_are_learned_are_not_evaluated(copy: Path) -> None:
    for path in (copy, as_coco(copy)):
        found = read(path)
        assert len(found.images) == IMAGES
        assert found.labelled is not None
        assert names(found.labelled) == [f"{number:04}" for number in range(1, IMAGES, 2)]


def test_the_labels_are_those_of_the_chosen_images(data: Path) -> None:
    found = read(data, 20)
    assert read(data / "images" / "val", 2).labelled is None
    assert found.labelled is not None
    pixels = [image.pixels for image in found.images[1::2]]
    for image in found.labelled.images:
        assert any(np.array_equal(ImageFile(image.path).load().pixels, each) for each in pixels)
        lines = (data / "labels" / "val" / f"{image.path.stem}.txt").read_text().splitlines()
        assert len(image.labels.boxes) == len(lines)


@pytest.mark.parametrize(
    ("name", "options", "useless"),
    [
        pytest.param("images/val", DataOptions(split="val"), "split", id="images"),
        pytest.param("truth.json", DataOptions(split="val"), "split", id="COCO"),
    ],
)
def test_an_option_that_does_not_apply_is_refused(
    name: str, options: DataOptions, useless: str, copy: Path
) -> None:
    as_coco(copy)
    with pytest.raises(DataError, match=f"--{useless} does not apply to"):
        read(copy / name, options=options)


def loss_on(path: Path, fp32: Detector, int8: Detector) -> float | str:
    """The loss of the embedded model on all images of `path`."""
    problems = Problems(lambda _: None)
    detectors = {"fp32": fp32, "int8": int8}
    settings = validated({"image_size": 320})
    found = labelled_data(path, DataOptions(), problems)
    return map_loss(
        found, load_weights(Path(WEIGHTS)), settings, detectors, observer=QUIET, problems=problems
    )


@pytest.mark.long
def test_the_loss_is_the_difference_of_two_evaluations(
    data: Path, detector: Detector, tmp_path: Path
) -> None:
    smaller = load_model(Path(WEIGHTS), runtime="onnxruntime", device="cpu", precision="fp32", image_size=192)
    points = loss_on(data, detector, smaller)
    report = tmp_path / "report"
    assert evaluate(data, "--compare", "image_size=192", "--output", str(report)) == 0
    found = report_of(report)
    expected = 100 * (found["all"]["ap50_95"] - found["comparison"]["rows"][0]["ap50_95"])
    assert expected > 1
    assert points == pytest.approx(expected, abs=0.02)
    assert loss_on(data, detector, detector) == 0


@pytest.mark.long
def test_unusable_labels_leave_the_loss_unknown(copy: Path, detector: Detector) -> None:
    text = (copy / "data.yaml").read_text()
    (copy / "data.yaml").write_text(text.partition("names:")[0] + "names: [dog]\n")
    for path in (copy / "labels" / "val").iterdir():
        path.write_text("0 0.5 0.5 0.2 0.2\n")
    assert "The data set has the classes dog" in str(loss_on(copy, detector, detector))


def calibrate(data: Path, output: Path, *words: str) -> int:
    return main([WEIGHTS, str(data), "--image-size", "320", "-o", str(output), *words])


@pytest.mark.long
@needs_openvino
def test_the_loss_is_reported(data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "best.calibration.json"
    assert calibrate(data, path) == 0
    told = capsys.readouterr().out
    assert read_calibration(path).image_size == 320
    (row,) = (line for line in told.splitlines() if line.startswith("int8 in openvino"))
    *_, points = map(float, row.split()[3:])
    assert len(row.split()) == 8
    assert -2 < points < 2
    assert "mAP loss    points of mAP@50:95 that int8 loses" in told


@pytest.mark.long
@needs_openvino
def test_without_pycocotools_labels_are_not_used_and_the_remedy_is_given(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pycocotools.cocoeval", None)
    path = tmp_path / "best.calibration.json"
    assert calibrate(data, path, "--images", "4") == 0
    told = capsys.readouterr().out
    assert "mAP loss    unknown: " in told
    assert "-m pip install pycocotools" in told
    assert path.is_file()
