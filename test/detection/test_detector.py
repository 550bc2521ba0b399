"""A detector puts letterbox, runtime and selection together and keeps nothing."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from support.gate import PATIENCE_S
from support.random_model import CLASS_NAMES, random_model
from support.runtime_names import EVERY_RUNTIME
from support.scripted_runtime import ScriptedRuntime

from yolov5_lifecycle.detection.detector import Detector
from yolov5_lifecycle.detection.nms import WORTH_TELLING, Selection
from yolov5_lifecycle.detection.prepared_model import load_detector
from yolov5_lifecycle.images.image import ChannelOrder, ColourImage
from yolov5_lifecycle.runtimes.runtime import InferenceError, Runtime

EVERYTHING = Selection(confidence_threshold=0.01)


def row(cx: float, cy: float, w: float, h: float, *scores: float) -> list[float]:
    return [cx, cy, w, h, 1.0, *scores]


def rows(*listed: list[float]) -> NDArray[np.float32]:
    return np.array(listed, np.float32).reshape(-1, 5 + len(CLASS_NAMES))


def predicting(raw: NDArray[np.float32]) -> ScriptedRuntime:
    return ScriptedRuntime(lambda: raw)


def detector_of(runtime: Runtime, image_size: int = 64) -> Detector:
    return Detector(runtime, class_names=CLASS_NAMES, image_size=image_size, stride=32)


def random_image(height: int, width: int, channel_order: ChannelOrder = "rgb") -> ColourImage:
    return ColourImage(np.random.default_rng(0).integers(0, 256, (height, width, 3), np.uint8), channel_order)


def test_boxes_come_back_in_pixels_of_the_image() -> None:
    # 100 x 200 becomes 32 x 64 in a frame of its own size: scale 0.32, no padding.
    runtime = predicting(rows(row(32, 16, 16, 8, 0, 0.75, 0), row(0, 0, 32, 16, 0.5, 0, 0)))
    found = detector_of(runtime).detect(random_image(100, 200), Selection())
    expected = np.array([[75, 37.5, 125, 62.5], [0, 0, 50, 25]])
    np.testing.assert_allclose(found.boxes_xyxy, expected, rtol=1e-5)
    assert found.scores.tolist() == [0.75, 0.5]
    assert found.class_ids.tolist() == [1, 0]


def test_a_detection_that_lies_all_in_the_padding_is_dropped() -> None:
    # 64 x 16 is 16 x 64 turned; its frame is 64 x 32 with 8 grey columns on each side.
    runtime = predicting(rows(row(4, 30, 6, 6, 1, 0, 0), row(4, 30, 12, 6, 0, 0.5, 0)))
    found = detector_of(runtime).detect(random_image(64, 16), Selection())
    np.testing.assert_array_equal(found.boxes_xyxy, [[0, 27, 2, 33]])
    assert found.class_ids.tolist() == [1]


@pytest.mark.parametrize(
    ("channel_order", "threshold", "least"), [("rgb", 0.03, 0.03), ("bgr", 0.6, WORTH_TELLING)]
)
def test_the_runtime_is_told_the_order_of_colours_and_which_predictions_matter(
    channel_order: ChannelOrder, threshold: float, least: float
) -> None:
    runtime = predicting(rows())
    detector_of(runtime).detect(
        random_image(30, 64, channel_order), Selection(confidence_threshold=threshold)
    )
    assert runtime.calls == [((32, 64, 3), channel_order, least)]


@pytest.mark.parametrize(
    ("raw", "message"),
    [
        pytest.param(
            np.zeros((4, 7), np.float32),
            r"\(N, 8\) for 3 classes, found float32 of shape \(4, 7\)",
            id="columns",
        ),
        pytest.param(np.zeros((1, 4, 8), np.float32), r"found float32 of shape \(1, 4, 8\)", id="axes"),
        pytest.param(rows(row(np.nan, 0, 1, 1, 0, 0, 0)), "not finite", id="NaN"),
        pytest.param(
            rows(row(0, 0, 1, 1, 0, 0, 0), row(0, 0, 1, 1, 0, -np.inf, 0)), "not finite", id="a class"
        ),
    ],
)
def test_predictions_that_cannot_be_are_an_error(raw: NDArray[np.float32], message: str) -> None:
    with pytest.raises(InferenceError, match=message):
        detector_of(predicting(raw)).detect(random_image(10, 10), Selection())


@pytest.mark.parametrize(
    ("image_size", "stride", "remedy"),
    [
        (650, 32, "650 is not a multiple of 32.*Use 640 or 672"),
        (0, 32, "Use 32 or 64"),
    ],
)
def test_an_image_size_off_the_stride_is_refused_with_the_nearest_good_ones(
    image_size: int, stride: int, remedy: str
) -> None:
    with pytest.raises(ValueError, match=remedy):
        Detector(predicting(rows()), class_names=CLASS_NAMES, image_size=image_size, stride=stride)


def test_warming_up_runs_each_network_input_size_of_several_cameras() -> None:
    runtime = predicting(rows())
    sizes_hw = [(480, 640), (720, 1280), (960, 1280), (640, 480), (1080, 1920)]
    detector_of(runtime, image_size=640).warm_up(sizes_hw)
    shapes = [shape for shape, *_ in runtime.calls]
    assert shapes == [(480, 640, 3)] * 2 + [(384, 640, 3)] * 2 + [(640, 480, 3)] * 2


@pytest.fixture(scope="module")
def detector() -> Detector:
    return load_detector(random_model(), device="cpu", runtime="torch", image_size=128)


@settings(max_examples=30, deadline=None)
@given(height=st.integers(1, 300), width=st.integers(1, 300))
def test_boxes_lie_in_the_image_whatever_its_size(detector: Detector, height: int, width: int) -> None:
    found = detector.detect(random_image(height, width), EVERYTHING)
    assert len(found)
    assert (found.boxes_xyxy >= 0).all()
    assert (found.boxes_xyxy <= [width, height, width, height]).all()
    assert (found.boxes_xyxy[:, 2:] > found.boxes_xyxy[:, :2]).all()
    assert (found.class_ids < len(CLASS_NAMES)).all()


@pytest.mark.parametrize("size_hw", [(1, 1), (1, 16384), (16384, 1)], ids=str)
def test_extreme_sizes_are_detected_in(detector: Detector, size_hw: tuple[int, int]) -> None:
    found = detector.detect(random_image(*size_hw), EVERYTHING)
    assert np.isfinite(found.boxes_xyxy).all()
    assert len(found) <= EVERYTHING.max_detections


def test_the_answer_depends_on_the_image_alone(detector: Detector) -> None:
    image = random_image(100, 80)
    first = detector.detect(image, EVERYTHING)
    detector.detect(random_image(50, 200), Selection(max_detections=1))
    again = detector.detect(image, EVERYTHING)
    turned = detector.detect(ColourImage(image.pixels[..., ::-1].copy(), "bgr"), EVERYTHING)
    for other in (again, turned):
        np.testing.assert_array_equal(first.boxes_xyxy, other.boxes_xyxy)
        np.testing.assert_array_equal(first.scores, other.scores)
        np.testing.assert_array_equal(first.class_ids, other.class_ids)


@pytest.mark.long
@pytest.mark.parametrize("runtime", EVERY_RUNTIME)
def test_threads_that_share_a_detector_get_what_one_gets(runtime: str) -> None:
    detector = load_detector(random_model(1), device="cpu", runtime=runtime, image_size=64)
    images = [random_image(48 + 16 * index, 64) for index in range(3)]
    expected = [detector.detect(image, EVERYTHING) for image in images]
    together = threading.Barrier(2)

    def detect_all(_: int) -> bool:
        together.wait(PATIENCE_S)
        found = [detector.detect(images[index % 3], EVERYTHING) for index in range(60)]
        return all(
            np.array_equal(one.boxes_xyxy, expected[index % 3].boxes_xyxy) for index, one in enumerate(found)
        )

    with ThreadPoolExecutor(2) as threads:
        assert list(threads.map(detect_all, range(2))) == [True, True]
