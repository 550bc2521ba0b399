"""Grey frames and networks for grey images, in every runtime, without a detour through colour."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
import pytest
from support.random_model import TINY, random_frame, random_model
from support.runtime_names import EVERY_RUNTIME

from yolov5_lifecycle.detection.detector import Detector
from yolov5_lifecycle.detection.nms import Selection
from yolov5_lifecycle.images.encodings import GreyImage, decode_raw
from yolov5_lifecycle.images.image import ColourImage
from yolov5_lifecycle.models.model import Model
from yolov5_lifecycle.runtimes.registry import load_runtime
from yolov5_lifecycle.runtimes.runtime import Runtime

GREY = cv2.cvtColor(random_frame(), cv2.COLOR_RGB2GRAY)
EVERY_CELL = Selection(confidence_threshold=0.01)


def loaded(model: Model, runtime_name: str) -> Runtime:
    return load_runtime(model, runtime_name, device="cpu", precision="fp32")


@pytest.fixture(params=EVERY_RUNTIME)
def runtime_name(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture
def grey_runtime(runtime_name: str) -> Runtime:
    return loaded(random_model(1, dataclasses.replace(TINY, image_channels=1)), runtime_name)


def test_a_grey_frame_is_the_same_for_a_colour_network_as_one_in_three_channels(runtime_name: str) -> None:
    runtime = loaded(random_model(1), runtime_name)
    expected = runtime(cv2.cvtColor(GREY, cv2.COLOR_GRAY2RGB), "rgb").rows
    np.testing.assert_array_equal(runtime(GREY, "grey").rows, expected)


def test_a_colour_frame_is_turned_grey_for_a_grey_network(grey_runtime: Runtime) -> None:
    frame = random_frame()
    expected = grey_runtime(GREY, "grey").rows
    np.testing.assert_array_equal(grey_runtime(frame, "rgb").rows, expected)
    np.testing.assert_array_equal(grey_runtime(frame[..., ::-1].copy(), "bgr").rows, expected)


@pytest.mark.long
def test_a_detector_sees_the_same_in_an_image_however_it_is_encoded(grey_runtime: Runtime) -> None:
    detector = Detector(grey_runtime, class_names=("cat", "dog", "cow"), image_size=96, stride=32)
    height, width = GREY.shape
    image = decode_raw(
        GREY.tobytes(), encoding="mono8", height=height, width=width, step=width, is_bigendian=False
    )
    assert isinstance(image, GreyImage)
    found = detector.detect(image, EVERY_CELL)
    assert len(found.scores)
    in_colour = detector.detect(ColourImage(image.pixels, "rgb"), EVERY_CELL)
    np.testing.assert_array_equal(found.boxes_xyxy, in_colour.boxes_xyxy)
