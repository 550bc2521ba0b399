"""Calibration on labelled images: which of them are evaluated, and how much mAP int8 loses there."""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from support.evaluated_offline import WEIGHTS, as_coco, evaluate, labelled_drive, report_of, shapes

from yolov5_lifecycle import load_model
from yolov5_lifecycle.checkpoints.locate import load_weights
from yolov5_lifecycle.detection.detector import Detector
from yolov5_lifecycle.evaluation.ground_truth import DataError, Problems
from yolov5_lifecycle.offline.calibrate.calibration_images import CalibrationData, read_calibration_data
from yolov5_lifecycle.offline.calibrate.command import main
from yolov5_lifecycle.offline.calibrate.measuring import map_loss
from yolov5_lifecycle.offline.detecting import RunStatistics
from yolov5_lifecycle.offline.evaluate.arguments import DataOptions
from yolov5_lifecycle.offline.evaluate.evaluating import LabelledData
from yolov5_lifecycle.offline.evaluate.labelled_data import has_labels, labelled_data
from yolov5_lifecycle.quantization.calibration_file import read_calibration
from yolov5_lifecycle.runtimes.registry import installed_runtimes
from yolov5_lifecycle.settings.settings import validated
from yolov5_lifecycle.streaming.frame_statistics import Outcome

IMAGES = 24

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


def _folder(path: Path, *names: str) -> Path:
    for name in names:
        (path / name).mkdir(parents=True)
    return path


@pytest.mark.parametrize(
    ("make", "expected"),
    [
        pytest.param(lambda data, _: data, True, id="YOLO"),
        pytest.param(lambda data, _: data / "data.yaml", True, id="data.yaml"),
        pytest.param(lambda data, _: as_coco(data), True, id="COCO"),
        pytest.param(lambda _, path: _folder(path, "images", "labels"), True, id="without data.yaml"),
        pytest.param(lambda data, _: data / "images" / "val", False, id="images alone"),
        pytest.param(lambda _, path: _folder(path, "labels"), False, id="labels alone"),
        pytest.param(lambda _, path: path / "drive.mp4", False, id="video"),
        pytest.param(lambda _, path: labelled_drive(path), False, id="recording"),
    ],
)
def test_data_sets_have_labels(
    make: Callable[[Path, Path], Path], expected: bool, copy: Path, tmp_path: Path
) -> None:
    assert has_labels(make(copy, tmp_path / "other")) is expected


class Notes:
    """A watch that keeps what is reported to it."""

    def __init__(self) -> None:
        self.told: list[str] = []

    def lost(self, label: str, outcome: Outcome, error: Exception) -> None:
        self.told.append(f"{label}: {error}")

    def progress(self, statistics: RunStatistics) -> None:
        pass


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


def names(data: LabelledData) -> list[str]:
    return [Path(image.label).stem for image in data.images()]


def test_images_whose_ranges_are_learned_are_not_evaluated(copy: Path) -> None:
    for path in (copy, as_coco(copy)):
        found = read(path)
        assert len(found.images) == IMAGES
        assert found.labelled is not None
        assert names(found.labelled) == [f"{number:04}" for number in range(1, IMAGES, 2)]
        assert found.labelled.expected == IMAGES // 2


def test_the_labels_are_those_of_the_chosen_images(data: Path) -> None:
    found = read(data, 20)
    assert found.labelled is not None
    pixels = [image.pixels for image in found.images[1::2]]
    for image in found.labelled.images():
        assert any(np.array_equal(image.load().pixels, each) for each in pixels)
        lines = (data / "labels" / "val" / f"{Path(image.label).stem}.txt").read_text().splitlines()
        assert len(image.labels.boxes) == len(lines)


def test_images_alone_have_no_labels(data: Path) -> None:
    assert read(data / "images" / "val").labelled is None


@pytest.mark.parametrize(
    ("name", "options", "useless"),
    [
        pytest.param("images/val", DataOptions(split="val"), "split", id="images"),
        pytest.param("truth.json", DataOptions(split="val"), "split", id="COCO"),
        pytest.param(".", DataOptions(topic="/image"), "topic", id="YOLO"),
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
    with labelled_data(path, DataOptions(), problems) as found:
        return map_loss(
            found, load_weights(Path(WEIGHTS)), settings, detectors, listener=Notes(), problems=problems
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


def _with_names(data: Path) -> Path:
    text = (data / "data.yaml").read_text()
    (data / "data.yaml").write_text(text.partition("names:")[0] + "names:\n  0: dog\n")
    for path in (data / "labels" / "val").iterdir():
        path.write_text("0 0.5 0.5 0.2 0.2\n")
    return data


def _without_objects(data: Path) -> Path:
    for path in (data / "labels" / "val").iterdir():
        path.write_text("")
    return data


def _crowds(data: Path) -> Path:
    path = as_coco(data)
    content = json.loads(path.read_text())
    for annotation in content["annotations"]:
        annotation["iscrowd"] = 1
    path.write_text(json.dumps(content))
    return path


@pytest.mark.long
@pytest.mark.parametrize(
    ("change", "reason"),
    [
        pytest.param(_with_names, "The data set has the classes dog", id="other classes"),
        pytest.param(_without_objects, "images has an object of the classes", id="no objects"),
        pytest.param(_crowds, "images has an object of the classes", id="crowds"),
    ],
)
def test_unusable_labels_leave_the_loss_unknown(
    change: Callable[[Path], Path], reason: str, copy: Path, detector: Detector
) -> None:
    assert reason in str(loss_on(change(copy), detector, detector))


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
