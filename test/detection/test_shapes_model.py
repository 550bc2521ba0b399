"""The embedded model finds circles, squares, triangles and stars, in the same steps as the node."""

from __future__ import annotations

import numpy as np
import pytest
from support.colcon_workspace import REPOSITORY

from tools.shapes.evaluate import IMAGES, UNSEEN_SEED, evaluate, moving, stills
from yolov5_lifecycle.checkpoints.locate import WeightsFile, load_weights
from yolov5_lifecycle.detection.detector import Detector
from yolov5_lifecycle.detection.loaded_detector import load_detector
from yolov5_lifecycle.detection.nms import Selection
from yolov5_lifecycle.images.image import ColourImage, Order
from yolov5_lifecycle.sources.scene import CLASS_NAMES, Scene

WEIGHTS = REPOSITORY / "weights"
PATH = WEIGHTS / "shapes.safetensors"


@pytest.fixture(scope="module")
def weights_file() -> WeightsFile:
    return load_weights(PATH)


def _detector(weights_file: WeightsFile, image_size: int) -> Detector:
    return load_detector(weights_file.model, device="cpu", image_size=image_size)


def test_the_file_is_small_and_knows_the_classes_of_the_scene(weights_file: WeightsFile) -> None:
    assert PATH.stat().st_size < 1_500_000
    assert weights_file.model.class_names == CLASS_NAMES


def test_the_model_card_describes_this_file(weights_file: WeightsFile) -> None:
    assert weights_file.sha256 in (WEIGHTS / "README.md").read_text()


@pytest.mark.long
def test_unseen_stills_are_detected_with_few_errors(weights_file: WeightsFile) -> None:
    result = evaluate(_detector(weights_file, 320), stills(UNSEEN_SEED, IMAGES, (256, 320)))
    assert len(result.scores) + result.missed > 2 * IMAGES
    assert set(result.class_ids) == set(range(len(CLASS_NAMES)))
    assert result.precision >= 0.95
    assert result.recall >= 0.95


@pytest.mark.long
@pytest.mark.parametrize(
    ("size_hw", "image_size"),
    [
        pytest.param((480, 640), 640, id="640x480 at 640", marks=pytest.mark.long),
        pytest.param((240, 320), 320, id="320x240 at 320"),
    ],
)
def test_moving_shapes_are_found_where_they_are(
    weights_file: WeightsFile, size_hw: tuple[int, int], image_size: int
) -> None:
    result = evaluate(_detector(weights_file, image_size), moving(UNSEEN_SEED, 100, size_hw))
    circles = result.scores[result.class_ids == CLASS_NAMES.index("circle")]
    assert result.recall >= 0.97
    assert result.precision >= 0.93
    assert (circles > 0.6).mean() >= 0.95


@pytest.mark.parametrize("level", [0, 114, 255])
def test_an_empty_image_has_no_shapes(weights_file: WeightsFile, level: int) -> None:
    empty = ColourImage(np.full((480, 640, 3), level, np.uint8), "rgb")
    assert len(_detector(weights_file, 320).detect(empty, Selection())) == 0


@pytest.mark.parametrize("order", ["rgb", "bgr"])
def test_every_class_is_found_in_either_order_of_colours(weights_file: WeightsFile, order: Order) -> None:
    pixels, _ = Scene(UNSEEN_SEED, (480, 640)).frame(0)
    image = ColourImage(pixels if order == "rgb" else pixels[..., ::-1].copy(), order)
    found = _detector(weights_file, 320).detect(image, Selection())
    assert set(found.class_ids) == set(range(len(CLASS_NAMES)))
