"""The command `calibrate`: what it reads, which images it takes, what it writes and refuses."""

from __future__ import annotations

import itertools
import os
import signal
from pathlib import Path

import cv2
import numpy as np
import pytest
from support.calibrations import a_calibration, calibration_at, measurement
from support.random_model import random_model

from yolov5_lifecycle import load_model
from yolov5_lifecycle.checkpoints.safetensors_file import write_safetensors
from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.images.image import ColourImage
from yolov5_lifecycle.offline.calibrate.agreement import agreement
from yolov5_lifecycle.offline.calibrate.calibration_frames import (
    ChosenImage,
    Source,
    diverse_images,
    farthest,
    fitted,
    of_one_size,
)
from yolov5_lifecycle.offline.calibrate.command import main, report, verdict
from yolov5_lifecycle.offline.image_files import VideoFrame
from yolov5_lifecycle.quantization.calibration_file import path_beside
from yolov5_lifecycle.ros.child_process import ChildProcess, entry_point
from yolov5_lifecycle.runtimes.processor_abilities import abilities, weight_bits
from yolov5_lifecycle.runtimes.registry import installed_runtimes

needs_openvino = pytest.mark.skipif(
    "openvino" not in installed_runtimes(), reason="no openvino: make install"
)


def plain(level: int, size_hw: tuple[int, int] = (48, 64)) -> ColourImage:
    return ColourImage(np.full((*size_hw, 3), level, np.uint8), "bgr")


def levels_of(found: list[ChosenImage]) -> list[int]:
    return [int(each.image.pixels[0, 0, 0]) for each in found]


def chosen(levels: list[int], count: int, *, claimed: int) -> list[int]:
    frames = [VideoFrame(number, float(number), plain(level)) for number, level in enumerate(levels)]
    found = diverse_images(
        Source(frames, claimed), count, lambda image: image, lost=lambda *_: None, seen=lambda _: None
    )
    assert [levels[each.number] for each in found] == levels_of(found)
    return levels_of(found)


def test_different_images_are_preferred_to_similar_ones() -> None:
    assert chosen([10, 10, 11, 10, 200, 10, 90, 11], 3, claimed=8) == [10, 200, 90]
    assert farthest(np.array([[0.0], [1.0], [9.0], [10.0], [5.0]]), 3) == [0, 3, 4]


@pytest.mark.parametrize("claimed", [200, 0, 3], ids=["known", "unknown", "wrong"])
def test_images_are_spread_over_a_source_of_any_claimed_length(claimed: int) -> None:
    found = chosen(list(range(200)), 5, claimed=claimed)
    assert len(found) == 5
    assert found[0] == 0
    assert found[-1] >= 140
    assert all(before < after for before, after in itertools.pairwise(found))


def test_a_source_without_images_has_none() -> None:
    assert chosen([], 5, claimed=0) == []
    assert of_one_size([]) == []


def test_all_images_get_the_size_of_most() -> None:
    images = [plain(9), plain(9), plain(200, (64, 48)), plain(90, (96, 128))]
    found = of_one_size(images)
    assert [image.size_hw for image in found] == [(48, 64)] * 4
    assert (found[2].pixels[24, 32] == 200).all()
    assert (found[2].pixels[24, 0] == 114).all()
    assert (found[3].pixels == 90).all()
    assert fitted(plain(9, (300, 400)), image_size=64, stride=32).size_hw == (64, 64)


def detections(*boxes: tuple[int, int, int]) -> Detections:
    """Boxes of 10 x 10 pixels at (x, y) of a class."""
    corners = np.array([(x, y, x + 10, y + 10) for x, y, _ in boxes], np.float32).reshape(-1, 4)
    return Detections(
        corners,
        np.linspace(0.9, 0.5, len(boxes), dtype=np.float32),
        np.array([class_id for *_, class_id in boxes], np.int64),
    )


@pytest.mark.parametrize(
    ("truth", "found", "f1", "box_iou"),
    [
        pytest.param(detections((0, 0, 1)), detections((0, 0, 1)), 1.0, 1.0, id="the same"),
        pytest.param(detections((0, 0, 1)), detections((0, 0, 2)), 0.0, 0.0, id="another class"),
        pytest.param(detections((0, 0, 1)), detections((2, 0, 1)), 1.0, 2 / 3, id="shifted"),
        pytest.param(detections((0, 0, 1)), detections((6, 0, 1)), 0.0, 0.0, id="elsewhere"),
        pytest.param(detections((0, 0, 1)), detections((0, 0, 1), (0, 1, 1)), 2 / 3, 1.0, id="found twice"),
        pytest.param(detections((0, 0, 1)), detections(), 0.0, 0.0, id="missed"),
        pytest.param(detections(), detections(), 1.0, 0.0, id="nothing to find"),
    ],
)
def test_agreement_counts_pairs(truth: Detections, found: Detections, f1: float, box_iou: float) -> None:
    same = agreement([truth], [found])
    assert same.f1 == pytest.approx(f1)
    assert same.box_iou == pytest.approx(box_iou)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A model with random weights, a folder with images of noise, one broken, and one without any."""
    folder = tmp_path_factory.mktemp("calibrate")
    write_safetensors(random_model(), folder / "best.safetensors")
    images = folder / "images"
    images.mkdir()
    rng = np.random.default_rng(0)
    for number in range(6):
        cv2.imwrite(str(images / f"{number}.png"), rng.integers(0, 256, (48, 64, 3), np.uint8))
    (images / "broken.png").write_bytes(b"no image")
    (folder / "empty").mkdir()
    return folder


@pytest.mark.end_to_end
@needs_openvino
def test_a_calibration_is_written_beside_the_weights_and_int8_uses_it(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    weights = folder / "best.safetensors"
    path = path_beside(weights)
    assert main([str(weights), str(folder / "images"), "--image-size", "64"]) == 0
    told = capsys.readouterr()
    assert "broken.png: left out: " in told.err
    calibration = calibration_at(path)
    assert told.out == report(calibration, path, "DATA has no labels")
    assert calibration.measurement("openvino", "int8").map_loss is None  # type: ignore[union-attr]
    assert (calibration.images, calibration.image_size) == (6, 64)
    assert {each.precision for each in calibration.measured} >= {"fp32", "int8"}
    detector = load_model(weights, precision="int8", device="cpu", image_size=64)
    assert detector.runtime.precision == "int8"
    detector.close()


@pytest.mark.long
@needs_openvino
@pytest.mark.parametrize(
    ("arguments", "problem"),
    [
        pytest.param(["best.safetensors", "nowhere"], "nowhere: file or folder not found", id="no data"),
        pytest.param(["nowhere.pt", "images"], "nowhere.pt", id="no weights"),
        pytest.param(["best.safetensors", "empty"], "empty", id="no images"),
        pytest.param(
            ["best.safetensors", "images", "--topic", "/x"],
            "--topic does not apply to ",
            id="topic of a folder",
        ),
        pytest.param(
            ["best.safetensors", "images", "--image-size", "65"], "multiple of 32", id="size of no network"
        ),
        pytest.param(["best.safetensors", "images", "-o", "gone/a.json"], "create it first", id="no folder"),
        pytest.param(["best.safetensors", "images", "-o", "empty"], "found a folder", id="folder"),
        pytest.param(["best.safetensors", "best.safetensors"], "best.safetensors", id="weights as data"),
    ],
)
def test_what_cannot_be_calibrated_is_refused_and_nothing_is_written(
    arguments: list[str],
    problem: str,
    folder: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(folder)
    before = {path: path.stat().st_mtime_ns for path in folder.rglob("*")}
    assert main(arguments) == 1
    told = capsys.readouterr()
    assert told.out == ""
    assert told.err.startswith("calibrate: ")
    assert problem in told.err
    assert {path: path.stat().st_mtime_ns for path in folder.rglob("*")} == before


@pytest.mark.long
@needs_openvino
def test_an_interrupted_calibration_writes_nothing(folder: Path, tmp_path: Path) -> None:
    output = tmp_path / "best.calibration.json"
    paths = [str(folder / "best.safetensors"), str(folder / "images"), "-o", str(output)]
    with ChildProcess("calibrate", [entry_point("calibrate"), *paths], os.environ) as process:
        process.wait_for_output("broken.png: left out", 60)
        assert process.stop(signal.SIGINT) == 130
    assert "interrupted; nothing was written" in process.output
    assert "Traceback" not in process.output
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("value", ["0", "2001", "-1", "many"])
def test_a_number_of_images_that_makes_no_sense_is_refused(
    value: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as end:
        main(["best.pt", "images", "--images", value])
    assert end.value.code == 2
    assert "expected 1 to 2000" in capsys.readouterr().err


def test_the_verdict_names_what_keeps_auto_at_fp32() -> None:
    def of(int8_ms: float, agreement_f1: float = 0.99) -> str:
        measured = (measurement("fp32", 20.0, 1.0), measurement("int8", int8_ms, agreement_f1))
        return verdict(a_calibration(measured=measured, weight_bits=weight_bits(abilities())))

    assert of(10.0).startswith("precision auto uses int8 because int8 is 2.00 x as fast as fp32 here")
    assert of(19.0).startswith("precision auto uses fp32 because int8 is 1.05 x as fast as fp32 here")
    assert of(10.0, 0.9).startswith("precision auto uses fp32 because int8 agrees with fp32 to 0.900 (F1)")
