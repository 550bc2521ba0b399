"""What every runtime does alike: rows, colours, embeddings, prototypes, streams, denormals, its end."""

from __future__ import annotations

import dataclasses
import threading
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from support.gate import PATIENCE_S
from support.random_model import (
    CLASS_NAMES,
    TINY,
    TINY_SEGMENT,
    random_frame,
    random_model,
    random_network,
)
from support.runtime_names import EVERY_RUNTIME

from yolov5_lifecycle.detection.detector import Detector
from yolov5_lifecycle.detection.nms import Selection, select
from yolov5_lifecycle.images.image import ChannelOrder, ColourImage
from yolov5_lifecycle.models.head import Segment
from yolov5_lifecycle.models.model import Model
from yolov5_lifecycle.models.network import Network
from yolov5_lifecycle.runtimes.compiled_runtime import DetectionHead
from yolov5_lifecycle.runtimes.networks_by_shape import are_zero
from yolov5_lifecycle.runtimes.onnx_graph import onnx_graph
from yolov5_lifecycle.runtimes.registry import load_runtime
from yolov5_lifecycle.runtimes.runtime import InferenceError, Predictions, Runtime

FRAMES = [random_frame(), 255 - random_frame(), random_frame()[::-1].copy()]
FRAME = FRAMES[0]
GREY = cv2.cvtColor(FRAME, cv2.COLOR_RGB2GRAY)


@pytest.fixture(params=EVERY_RUNTIME, scope="module")
def runtime_name(request: pytest.FixtureRequest) -> str:
    return str(request.param)


def loaded(model: Model, runtime_name: str) -> Runtime:
    return load_runtime(model, runtime_name, device="cpu", precision="fp32")


@pytest.fixture(scope="module")
def runtime(runtime_name: str) -> Runtime:
    return loaded(random_model(1), runtime_name)


@pytest.fixture(scope="module")
def segmenting(runtime_name: str) -> Runtime:
    return loaded(random_model(1, TINY_SEGMENT), runtime_name)


@pytest.fixture(scope="module")
def every_row() -> NDArray[np.float32]:
    """What the network as it was trained predicts for every anchor of every cell."""
    network = random_network(1)
    with torch.inference_mode():
        return np.asarray(network.predictions(features_of(network, FRAME))[0])


def features_of(network: Network, frame: NDArray[np.uint8]) -> list[torch.Tensor]:
    with torch.inference_mode():
        return network.features(torch.from_numpy(frame.copy()).permute(2, 0, 1)[None] / 255)


def test_all_rows_are_those_of_the_network_and_their_order_of_colours_makes_no_difference(
    runtime: Runtime, every_row: NDArray[np.float32]
) -> None:
    predictions = runtime(FRAME, "rgb")
    rows = predictions.rows
    assert predictions.compute_prototypes is None
    np.testing.assert_allclose(rows, every_row, rtol=1e-3, atol=1e-3)
    np.testing.assert_array_equal(rows, runtime(FRAME[..., ::-1].copy(), "bgr").rows)
    assert not np.array_equal(rows, runtime(FRAME, "bgr").rows)


@pytest.mark.parametrize("rank", [0, 100, -1], ids=lambda rank: f"rank {rank}")
def test_all_that_are_likely_enough_are_given_in_their_order_and_few_others(
    rank: int, runtime: Runtime, every_row: NDArray[np.float32]
) -> None:
    least = float(np.sort(every_row[:, 4])[::-1][rank])
    distances = np.abs(runtime(FRAME, "rgb", least - 1e-5).rows[:, None] - every_row[None]).max(axis=2)
    assert distances.min(axis=1).max() < 1e-3
    places = [int(place) for place in distances.argmin(axis=1)]
    assert places == sorted(set(places))
    wanted = np.flatnonzero(every_row[:, 4] >= least)
    assert set(wanted) <= set(places)
    assert len(places) <= 3 * len(wanted), "more than the cells with one of them"


@pytest.mark.parametrize("least", [0.999, 1.0])
def test_none_is_given_when_none_is_likely_enough(least: float, runtime: Runtime) -> None:
    rows = runtime(FRAME, "rgb", least).rows
    assert rows.shape == (0, 5 + len(CLASS_NAMES))
    assert rows.dtype == np.float32


@pytest.mark.parametrize("threshold", [0.0, 0.2, 0.9])
@pytest.mark.parametrize(("agnostic", "classes"), [(False, None), (True, None), (False, {1})])
def test_detections_and_the_best_that_was_missed_are_those_of_all_predictions(
    threshold: float, agnostic: bool, classes: set[int] | None, runtime: Runtime
) -> None:
    wanted = None if classes is None else frozenset(classes)
    selection = Selection(confidence_threshold=threshold, agnostic_nms=agnostic, classes=wanted)
    found, expected = (
        select(runtime(FRAME, "rgb", least).rows, selection) for least in (selection.min_objectness, 0.0)
    )
    np.testing.assert_array_equal(found.class_ids, expected.class_ids)
    np.testing.assert_allclose(found.boxes_xyxy, expected.boxes_xyxy, rtol=0, atol=1e-3)
    assert found.best_missed == pytest.approx(expected.best_missed, abs=1e-6)


@pytest.mark.long
@pytest.mark.parametrize(
    ("key", "place", "value"),
    [
        pytest.param("model.0.conv.weight", 0, np.inf, id="infinity in the first layer"),
        pytest.param("model.24.m.0.bias", 4, np.nan, id="NaN as objectness"),
    ],
)
def test_weights_that_give_no_numbers_are_noticed_whatever_the_threshold(
    key: str, place: int, value: float, runtime_name: str
) -> None:
    model = random_model(5)
    model.state_dict[key].view(-1)[place] = value
    detector = Detector(loaded(model, runtime_name), class_names=CLASS_NAMES, image_size=96, stride=32)
    for threshold in (0.0, 1.0):
        with pytest.raises(InferenceError, match="not finite"):
            detector.detect(ColourImage(FRAME, "rgb"), Selection(confidence_threshold=threshold))


def test_a_grey_frame_is_the_same_for_a_colour_network_as_one_in_three_channels(runtime: Runtime) -> None:
    expected = runtime(cv2.cvtColor(GREY, cv2.COLOR_GRAY2RGB), "rgb").rows
    np.testing.assert_array_equal(runtime(GREY, "grey").rows, expected)


def test_a_colour_frame_is_turned_grey_for_a_grey_network(runtime_name: str) -> None:
    runtime = loaded(random_model(1, dataclasses.replace(TINY, image_channels=1)), runtime_name)
    expected = runtime(GREY, "grey").rows
    np.testing.assert_array_equal(runtime(FRAME, "rgb").rows, expected)
    np.testing.assert_array_equal(runtime(FRAME[..., ::-1].copy(), "bgr").rows, expected)


def test_an_embedding_is_the_mean_of_the_coarsest_features_of_its_frame(runtime: Runtime) -> None:
    for frame in FRAMES:
        compute = runtime(frame, "rgb").compute_embedding
        assert compute is not None
        expected = features_of(random_network(1), frame)[-1][0].mean(dim=(1, 2))
        np.testing.assert_allclose(compute(), expected, rtol=1e-3, atol=1e-4)


def prototypes(predictions: Predictions) -> NDArray[np.float32]:
    assert predictions.compute_prototypes is not None
    return predictions.compute_prototypes()


def test_prototypes_and_coefficients_are_those_of_the_network(segmenting: Runtime) -> None:
    network = random_network(1, TINY_SEGMENT)
    assert isinstance(network.head, Segment)
    for frame in FRAMES:
        features = features_of(network, frame)
        predictions = segmenting(frame, "rgb")
        with torch.inference_mode():
            rows, wanted = network.predictions(features)[0], network.head.proto(features[0])[0]
        np.testing.assert_allclose(predictions.rows, rows, rtol=1e-3, atol=1e-3)
        np.testing.assert_allclose(prototypes(predictions), wanted, rtol=1e-3, atol=1e-3)


def test_frames_predictions_and_prototypes_stay_as_they_are(segmenting: Runtime) -> None:
    frame = FRAME.copy()
    predictions = segmenting(frame, "rgb")
    kept = (frame, predictions.rows, prototypes(predictions), prototypes(predictions))
    before = [each.copy() for each in kept]
    orders: Sequence[ChannelOrder] = ("rgb", "bgr")
    for channel_order in orders:
        prototypes(segmenting(FRAMES[1], channel_order))
    for now, then in zip(kept, before, strict=True):
        np.testing.assert_array_equal(now, then)


def test_a_closed_runtime_says_so_and_may_be_closed_again(runtime_name: str) -> None:
    runtime = loaded(random_model(1, TINY_SEGMENT), runtime_name)
    predictions = runtime(FRAME, "rgb")
    runtime.close()
    runtime.close()
    with pytest.raises(InferenceError, match="closed; load the model again"):
        runtime(FRAME, "rgb")
    with pytest.raises(InferenceError, match="closed"):
        prototypes(predictions)


@pytest.mark.long
def test_streams_give_the_same_predictions_at_the_same_time(runtime: Runtime) -> None:
    first, *others = runtime.streams(3, threads=1)
    expected = [first(frame, "rgb").rows for frame in FRAMES]
    np.testing.assert_allclose(expected[0], runtime(FRAME, "rgb").rows, rtol=1e-3, atol=1e-3)
    together = threading.Barrier(3)

    def run(each: Runtime) -> bool:
        together.wait(PATIENCE_S)
        return all(
            np.array_equal(each(FRAMES[index % 3], "rgb").rows, expected[index % 3]) for index in range(30)
        )

    with ThreadPoolExecutor(3) as threads:
        assert list(threads.map(run, (first, *others))) == [True, True, True]


@pytest.mark.long
def test_streams_are_closed_one_by_one_and_outlive_the_runtime_that_they_come_from(runtime_name: str) -> None:
    runtime = loaded(random_model(1), runtime_name)
    left, right = runtime.streams(2, threads=1)
    expected = left(FRAME, "rgb").rows
    left.close()
    runtime.close()
    np.testing.assert_array_equal(right(FRAME, "rgb").rows, expected)
    for use in (lambda: left(FRAME, "rgb"), lambda: runtime.streams(2, threads=1)):
        with pytest.raises(InferenceError, match="closed"):
            use()


@pytest.mark.parametrize("name", ["onnxruntime", "openvino"])
def test_streams_share_one_compiled_network(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    recorded: list[tuple[int, int]] = []

    def watched(network: Network, shape: tuple[int, int], *others: Any) -> bytes:
        recorded.append(shape)
        return onnx_graph(network, shape, *others)

    monkeypatch.setattr("yolov5_lifecycle.runtimes.compiled_runtime.onnx_graph", watched)
    for stream in loaded(random_model(1), name).streams(3, threads=2):
        stream(FRAME, "rgb")
    assert recorded == [FRAME.shape[:2]]


def test_torch_uses_the_threads_of_a_stream_only_in_the_stream(monkeypatch: pytest.MonkeyPatch) -> None:
    """Although torch hands the number of threads that was set last on to every thread that begins."""
    before, seen = torch.get_num_threads(), list[int]()
    original = Network.features
    with ThreadPoolExecutor(1) as late:

        def watched(*arguments: Any) -> Any:
            seen.append(torch.get_num_threads())
            if len(seen) == 1:  # in the stream
                late.submit(runtime, FRAME, "rgb").result()
            return original(*arguments)

        monkeypatch.setattr(Network, "features", watched)
        runtime = loaded(random_model(1), "torch")
        (stream,) = runtime.streams(1, threads=before + 1)
        stream(FRAME, "rgb")
    runtime(FRAME, "rgb")
    assert seen == [before + 1, before, before]
    assert torch.get_num_threads() == before


@pytest.mark.long
def test_denormal_numbers_are_zero_while_a_network_runs_and_not_after(
    runtime_name: str, runtime: Runtime, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A network that computes with them takes ten times as long, and weights can be made for that."""
    seen: list[bool] = []
    owner, attribute = (Network, "features") if runtime_name == "torch" else (DetectionHead, "__call__")
    original = getattr(owner, attribute)

    def watched(*arguments: Any) -> Any:
        seen.append(are_zero())
        return original(*arguments)

    monkeypatch.setattr(owner, attribute, watched)
    runtime(FRAME, "rgb")
    assert seen == [True]
    assert not are_zero()
