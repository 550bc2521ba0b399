"""Images of several cameras as one batch: the detections of each are those that it has alone."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from numpy.typing import NDArray
from support.colcon_workspace import REPOSITORY
from support.random_model import CLASS_NAMES
from support.runtime_names import EVERY_RUNTIME
from support.scripted_runtime import ScriptedRuntime

from yolov5_lifecycle.checkpoints.locate import load_weights
from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.detection.detector import Batches, Detector
from yolov5_lifecycle.detection.loaded_detector import load_detector
from yolov5_lifecycle.detection.nms import Selection
from yolov5_lifecycle.images.image import ColourImage
from yolov5_lifecycle.runtimes.runtime import DeviceLostError, InferenceError
from yolov5_lifecycle.sources.scene import Scene

NOTHING = np.empty((0, 5 + len(CLASS_NAMES)), np.float32)


def cat(score: float = 0.9) -> NDArray[np.float32]:
    """One raw row."""
    return np.array([[32, 32, 16, 8, 1, score, 0, 0]], np.float32)


def predicting(*predictions: NDArray[np.float32] | Exception) -> ScriptedRuntime:
    """A runtime that predicts or raises one after another."""
    scripted: Iterator[NDArray[np.float32] | Exception] = iter(predictions)

    def run() -> NDArray[np.float32]:
        prediction = next(scripted)
        if isinstance(prediction, Exception):
            raise prediction
        return prediction

    return ScriptedRuntime(run)


def detector_of(runtime: ScriptedRuntime) -> Detector:
    return Detector(runtime, class_names=CLASS_NAMES, image_size=64, stride=32)


def grey(height: int = 64, width: int = 64) -> ColourImage:
    return ColourImage(np.full((height, width, 3), 114, np.uint8), "rgb")


def failing_batch() -> None:
    raise InferenceError("out of memory")


@pytest.mark.long
@pytest.mark.parametrize("runtime_name", EVERY_RUNTIME)
def test_detections_of_a_batch_are_those_of_each_image_alone(runtime_name: str) -> None:
    model = load_weights(REPOSITORY / "weights" / "shapes.safetensors").model
    detector = load_detector(model, runtime=runtime_name, device="cpu", image_size=320)
    small, large = Scene(8, (240, 320)), Scene(9, (480, 640))
    shown = [small.frame(0)[0], large.frame(3)[0][..., ::-1].copy(), small.frame(20)[0]]
    images = [ColourImage(shown[0], "rgb"), ColourImage(shown[1], "bgr"), ColourImage(shown[2], "rgb")]
    selections = [Selection(), Selection(confidence_threshold=0.6), Selection(max_detections=1)]
    results = detector.detect_batch(images, selections)
    for result, image, selection in zip(results, images, selections, strict=True):
        expected = detector.detect(image, selection)
        assert isinstance(result, Detections)
        assert len(expected) > 0
        np.testing.assert_array_equal(result.class_ids, expected.class_ids)
        np.testing.assert_allclose(result.scores, expected.scores, rtol=0, atol=1e-4)
        np.testing.assert_allclose(result.boxes_xyxy, expected.boxes_xyxy, rtol=0, atol=0.05)
        assert result.best_missed == pytest.approx(expected.best_missed, abs=1e-4)


@pytest.mark.parametrize("count", [0, 1, 2, 5])
def test_several_images_are_one_run_and_a_single_one_is_none(count: int) -> None:
    runtime = predicting(*[cat()] * count)
    results = detector_of(runtime).detect_batch([grey()] * count, [Selection()] * count)
    assert [len(result) for result in results if isinstance(result, Detections)] == [1] * count
    assert runtime.batches == ([count] if count > 1 else [])


def test_every_image_has_its_own_order_thresholds_and_size() -> None:
    runtime = predicting(cat(0.5), cat(0.5), cat(0.5))
    images = [grey(64, 64), ColourImage(grey(128, 128).pixels, "bgr"), grey(32, 32)]
    thresholds = (0.3, 0.6, 0.02)
    results = detector_of(runtime).detect_batch(
        images, [Selection(confidence_threshold=threshold) for threshold in thresholds]
    )
    boxes = [result.boxes_xyxy.tolist() for result in results if isinstance(result, Detections)]
    assert boxes == [[[24, 28, 40, 36]], [], [[12, 14, 20, 18]]]
    assert [order for _, order, _ in runtime.calls] == ["rgb", "bgr", "rgb"]
    assert [least for *_, least in runtime.calls] == [0.05, 0.05, 0.02]


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        pytest.param(np.full_like(cat(), np.nan), "not finite", id="NaN"),
        pytest.param(cat()[:, :7], "Expected float32 predictions of shape", id="another shape"),
    ],
)
def test_an_image_with_predictions_that_cannot_be_does_not_spoil_the_others(
    bad: NDArray[np.float32], message: str
) -> None:
    runtime = predicting(cat(), bad, NOTHING)
    first, second, third = detector_of(runtime).detect_batch([grey()] * 3, [Selection()] * 3)
    assert isinstance(first, Detections)
    assert len(first) == 1
    assert isinstance(second, InferenceError)
    assert message in str(second)
    assert isinstance(third, Detections)
    assert len(third) == 0
    assert runtime.batches == [3]


@pytest.mark.parametrize(
    ("images", "selections"),
    [
        pytest.param([grey(64, 64), grey(32, 64)], [Selection()] * 2, id="two network input sizes"),
        pytest.param([grey()] * 2, [Selection()], id="a selection is missing"),
    ],
)
def test_what_is_no_batch_is_refused(images: list[ColourImage], selections: list[Selection]) -> None:
    with pytest.raises(ValueError, match="A batch needs images of one network input size"):
        detector_of(predicting()).detect_batch(images, selections)


def test_images_of_a_batch_that_fails_are_run_alone_and_there_are_no_more_batches(
    caplog: pytest.LogCaptureFixture,
) -> None:
    runtime = predicting(cat(), cat())
    runtime.on_batch = failing_batch
    detector = detector_of(runtime)
    detector.batches = Batches((2,), "of 2: faster")
    results = detector.detect_batch([grey()] * 2, [Selection()] * 2)
    assert [len(result) for result in results if isinstance(result, Detections)] == [1, 1]
    assert detector.batch_sizes == ()
    assert detector.batches.reason == "none: a batch of 2 failed: out of memory"
    assert "No more batches until the model is loaded again, because one failed: out of memory" in caplog.text


def test_a_runtime_that_fails_altogether_gives_each_image_its_error_and_keeps_its_batches() -> None:
    errors = [InferenceError("closed"), DeviceLostError("the GPU is gone")]
    runtime = predicting(*errors)
    runtime.on_batch = failing_batch
    detector = detector_of(runtime)
    detector.batches = Batches((2,), "of 2: faster")
    assert detector.detect_batch([grey()] * 2, [Selection()] * 2) == errors
    assert detector.batch_sizes == (2,)


def test_images_of_equal_network_input_size_need_not_be_of_equal_size() -> None:
    detector = Detector(predicting(), class_names=CLASS_NAMES, image_size=640, stride=32)
    assert detector.network_hw((720, 1280)) == detector.network_hw((1080, 1920)) == (384, 640)
    assert detector.network_hw((480, 640)) == (480, 640)
