"""The command `calibrate`: what it reads, which images it takes, what it writes and refuses."""

from __future__ import annotations

import itertools
import os
import shutil
import signal
from pathlib import Path

import cv2
import numpy as np
import pytest
from support.calibrations import a_calibration
from support.random_model import random_model
from support.refusals import Refused

from yolov5_lifecycle import load_model
from yolov5_lifecycle.checkpoints.safetensors_file import write_safetensors
from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.images.image import ColourImage
from yolov5_lifecycle.offline.calibrate.calibration_images import (
    diverse_images,
    farthest,
    fitted,
    of_one_size,
)
from yolov5_lifecycle.offline.calibrate.command import main, report
from yolov5_lifecycle.offline.calibrate.measuring import Measurement, Worth, agreement
from yolov5_lifecycle.offline.image_files import VideoFrame
from yolov5_lifecycle.quantization.calibration_file import path_beside, read_calibration
from yolov5_lifecycle.ros.child_process import ChildProcess, entry_point
from yolov5_lifecycle.runtimes.registry import installed_runtimes
from yolov5_lifecycle.runtimes.speed import Taken

needs_openvino = pytest.mark.skipif(
    "openvino" not in installed_runtimes(), reason="no openvino: make install"
)


def plain(level: int, size_hw: tuple[int, int] = (48, 64)) -> ColourImage:
    return ColourImage(np.full((*size_hw, 3), level, np.uint8), "bgr")


def chosen(levels: list[int], count: int, *, claimed: int) -> list[int]:
    frames = [VideoFrame(number, float(number), plain(level)) for number, level in enumerate(levels)]
    found = diverse_images(
        frames, claimed, count, lambda image: image, lost=lambda *_: None, seen=lambda _: None
    )
    return [int(image.pixels[0, 0, 0]) for image in found]


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
    ("truth", "found", "f1"),
    [
        pytest.param(detections((0, 0, 1)), detections((0, 0, 2)), 0.0, id="another class"),
        pytest.param(detections((0, 0, 1)), detections((3, 0, 1)), 1.0, id="an IoU of 0.54"),
        pytest.param(detections((0, 0, 1)), detections((4, 0, 1)), 0.0, id="an IoU of 0.43"),
        pytest.param(detections((0, 0, 1)), detections((0, 0, 1), (0, 1, 1)), 2 / 3, id="found twice"),
        pytest.param(detections(), detections(), 1.0, id="nothing to find"),
    ],
)
def test_agreement_counts_pairs(truth: Detections, found: Detections, f1: float) -> None:
    assert agreement([truth], [found]) == pytest.approx(f1)


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
    (folder / "data.yaml").touch()
    (folder / "labels").mkdir()
    taken = shutil.copy(folder / "best.safetensors", folder / "taken.safetensors")
    path_beside(Path(taken)).mkdir()
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
    assert "broken.png: rejected: " in told.err
    for line in ("fp32 in openvino  ", "int8 in openvino  ", "layers      "):
        assert line in told.out
    assert told.out.splitlines()[-2] == f"written     {path}"
    assert told.out.splitlines()[-1].startswith(("int8 does not pay: ", "int8 pays: "))
    assert read_calibration(path).image_size == 64
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
            ["best.safetensors", "data.yaml"], "of a data set, give the folder of its images", id="data set"
        ),
        pytest.param(
            ["best.safetensors", "."], "of a data set, give the folder of its images", id="its folder"
        ),
        pytest.param(
            ["best.safetensors", "images", "--topic", "/x"],
            "--topic does not apply to ",
            id="topic of a folder",
        ),
        pytest.param(
            ["best.safetensors", "images", "--image-size", "65"], "multiple of 32", id="size of no network"
        ),
        pytest.param(
            ["taken.safetensors", "images"], "expected a file to write, found a folder", id="folder"
        ),
        pytest.param(["best.safetensors", "best.safetensors"], "best.safetensors", id="weights as data"),
    ],
)
def test_what_cannot_be_calibrated_is_refused_and_nothing_is_written(
    arguments: list[str], problem: str, folder: Path, monkeypatch: pytest.MonkeyPatch, refused: Refused
) -> None:
    monkeypatch.chdir(folder)
    told = refused(main, *arguments)
    assert told.startswith("calibrate: ")
    assert problem in told


@pytest.mark.long
@needs_openvino
def test_an_interrupted_calibration_writes_nothing(folder: Path, tmp_path: Path) -> None:
    weights = Path(shutil.copy(folder / "best.safetensors", tmp_path))
    paths = [str(weights), str(folder / "images")]
    with ChildProcess("calibrate", [entry_point("calibrate"), *paths], os.environ) as process:
        process.wait_for_output("broken.png: rejected", 60)
        assert process.stop(signal.SIGINT) == 130
    assert "interrupted; unfinished output was removed" in process.output
    assert "Traceback" not in process.output
    assert list(tmp_path.iterdir()) == [weights]


def worth(int8_ms: float, f1: float = 0.99, *, saved: float = 3.0, detections: int = 50) -> Worth:
    """fp32 takes 26 and 20 ms; `saved`: processor time of fp32 / that of int8."""
    measured = (
        Measurement("openvino", "fp32", Taken(26.0, 70.0), 1.0),
        Measurement("openvino", "int8", Taken(int8_ms, 60.0 / saved), f1),
        Measurement("onnxruntime", "fp32", Taken(20.0, 60.0), 1.0),
    )
    return Worth(measured, detections)


@pytest.mark.parametrize(
    ("measured", "told"),
    [
        pytest.param(
            worth(10.0),
            "int8 pays: int8 is 2.00 x as fast as fp32 here (10.0 ms, not 20.0; 3.00 x by processor time) "
            "and agrees with it to 0.990 (F1). With image_size 320, type: ros2 param set /yolov5 precision "
            "int8",
            id="faster and good",
        ),
        pytest.param(worth(17.3), "int8 pays: ", id="just fast enough"),
        pytest.param(worth(17.5), "int8 does not pay: int8 is 1.14 x as fast", id="hardly faster"),
        pytest.param(worth(10.0, saved=1.1), "int8 does not pay: ", id="faster beside a busy process only"),
        pytest.param(worth(10.0, 0.98), "int8 pays: ", id="just good enough"),
        pytest.param(worth(17.5, 0.979), "int8 does not pay: int8 agrees with fp32 to 0.979 (F1)", id="bad"),
        pytest.param(
            worth(10.0, detections=49), "int8 does not pay: only 49 detections", id="too few detections"
        ),
    ],
)
def test_the_verdict_is_the_line_to_type_or_why_not(measured: Worth, told: str) -> None:
    assert measured.verdict(320).startswith(told)
    assert measured.verdict(320).endswith(("precision int8", "Keep precision auto, which is fp32 on a CPU."))


def test_the_report_has_a_row_for_each_runtime_and_precision(tmp_path: Path) -> None:
    lines = report(a_calibration(), worth(10.0), tmp_path).splitlines()
    assert [line.split()[-2:] for line in lines[1:4]] == [
        ["70.0", "1.000"],
        ["20.0", "0.990"],
        ["60.0", "1.000"],
    ]
    assert "layers      1 in int8, 1 and the last one in fp32" in lines
