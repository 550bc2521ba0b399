"""An export is run as it is: its rows, masks and batches, in both runtimes; what it cannot be is refused."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import onnxruntime
import pytest
import torch
from numpy.typing import NDArray
from onnx import numpy_helper
from support import hostile_onnx
from support.checkpoint_builder import SMALL
from support.formula_model import expected_predictions, formula_model, formula_pixels
from support.onnx_exports import BOX_PX, FINE, NAMES, STRIDE, exported, small_export, weights
from support.random_model import random_network
from support.runtime_names import COMPILED_RUNTIMES
from support.small_families import RESIZED, SMALL_FAMILIES
from torch.nn import functional

from yolov5_lifecycle.checkpoints.onnx_file import read_onnx
from yolov5_lifecycle.models.architecture import Architecture
from yolov5_lifecycle.models.head import Segment
from yolov5_lifecycle.runtimes.networks_by_shape import are_zero
from yolov5_lifecycle.runtimes.registry import load_export
from yolov5_lifecycle.runtimes.runtime import InferenceError, Predictions, Runtime

SIZE_HW = (64, 96)
LAYOUTS = pytest.mark.parametrize("has_objectness", [True, False], ids=["YOLOv5", "without objectness"])


@pytest.fixture(params=COMPILED_RUNTIMES)
def runtime_name(request: pytest.FixtureRequest) -> str:
    return str(request.param)


def loaded(runtime_name: str, **options: Any) -> Runtime:
    return load_export(read_onnx(small_export(**options)), runtime_name, device="cpu", precision="auto")


def frame(seed: int = 0, size_hw: tuple[int, int] = SIZE_HW) -> NDArray[np.uint8]:
    return np.random.default_rng(seed).integers(0, 256, (*size_hw, 3), np.uint8)


def convolved(pixels: NDArray[np.uint8], outputs: int, side: int) -> NDArray[np.float64]:
    """What the convolution of an export makes, (outputs, ny, nx)."""
    weight, bias = (torch.from_numpy(each).double() for each in weights(outputs, side))
    planes = torch.from_numpy(pixels).permute(2, 0, 1).double() / 255
    found: NDArray[np.float64] = functional.conv2d(planes, weight, bias, stride=side).numpy()
    return found


def expected_rows(
    pixels: NDArray[np.uint8], *, has_objectness: bool, masks: int, least: float
) -> NDArray[np.float64]:
    columns = 1 / (1 + np.exp(-convolved(pixels, 4 + has_objectness + len(NAMES) + masks, STRIDE)))
    columns[:4] *= BOX_PX
    rows = []
    for row in columns.reshape(len(columns), -1).T.tolist():
        if has_objectness and row[4] >= least:
            rows.append(row)
        elif not has_objectness and max(row[4 : 4 + len(NAMES)]) >= least:
            rows.append([*row[:4], 1.0, *row[4:]])
    return np.array(rows)


@LAYOUTS
@pytest.mark.parametrize(
    "options",
    [
        pytest.param({}, id="fixed"),
        pytest.param({"size_hw": None, "batch": None}, id="dynamic"),
        pytest.param({"is_half": True}, id="fp16"),
        pytest.param({"masks": 4}, id="masks"),
        pytest.param({"masks": 4, "batch": 2}, id="masks, batch of 2"),
        pytest.param({"has_raw_outputs": True}, id="raw outputs"),
    ],
)
def test_rows_are_those_of_the_convolution_of_the_image(
    runtime_name: str, options: dict[str, Any], has_objectness: bool
) -> None:
    pixels, masks = frame(), options.get("masks", 0)
    tolerance = 2e-2 if "is_half" in options else 1e-4
    runtime = loaded(runtime_name, has_objectness=has_objectness, **options)
    everything = expected_rows(pixels, has_objectness=has_objectness, masks=masks, least=0.0)
    scores = everything[:, 4] if has_objectness else everything[:, 5 : 5 + len(NAMES)].max(axis=1)
    least = float(np.sort(scores)[2:4].mean())
    likely = expected_rows(pixels, has_objectness=has_objectness, masks=masks, least=least)
    assert 0 < len(likely) < len(everything)
    predictions = runtime(pixels, "rgb")
    np.testing.assert_allclose(predictions.rows, everything, rtol=tolerance, atol=tolerance)
    if masks:
        np.testing.assert_allclose(prototypes(predictions), convolved(pixels, masks, FINE), atol=1e-4)
    found = runtime(pixels[..., ::-1].copy(), "bgr", least).rows
    np.testing.assert_allclose(found, likely, rtol=tolerance, atol=tolerance)


def prototypes(predictions: Predictions) -> NDArray[np.float32]:
    assert predictions.compute_prototypes is not None
    return predictions.compute_prototypes()


def test_a_dynamic_export_takes_any_size(runtime_name: str) -> None:
    runtime = loaded(runtime_name, size_hw=None)
    for size_hw in ((32, 64), (128, 32)):
        expected = expected_rows(frame(0, size_hw), has_objectness=True, masks=0, least=0.0)
        np.testing.assert_allclose(runtime(frame(0, size_hw), "rgb").rows, expected, atol=1e-4)


def without_numbers(model: Any) -> None:
    array = hostile_onnx.array(model, "logits.bias")
    array.raw_data = np.full(len(array.raw_data) // 4, np.nan, np.float32).tobytes()


@LAYOUTS
def test_rows_without_numbers_are_not_left_out(runtime_name: str, has_objectness: bool) -> None:
    """The detector notices them."""
    export = read_onnx(hostile_onnx.changed(without_numbers, has_objectness=has_objectness)())
    runtime = load_export(export, runtime_name, device="cpu", precision="auto")
    assert len(runtime(frame(), "rgb", 0.9).rows) == 6


def scaled(**factors: float) -> Callable[[Any], None]:
    """A change of the columns of boxes (`px`) and of the others (`share`)."""

    def change(model: Any) -> None:
        array = hostile_onnx.array(model, "scale")
        found = numpy_helper.to_array(array).copy()
        found[:4] *= factors.get("px", 1)
        found[4:] *= factors.get("share", 1)
        array.CopyFrom(numpy_helper.from_array(found, "scale"))

    return change


@LAYOUTS
@pytest.mark.parametrize("factors", [{"px": -1}, {"share": -1}, {"share": 9}], ids=str)
def test_boxes_and_scores_of_another_meaning_are_told(
    runtime_name: str, has_objectness: bool, factors: dict[str, float]
) -> None:
    export = read_onnx(hostile_onnx.changed(scaled(**factors), has_objectness=has_objectness)())
    runtime = load_export(export, runtime_name, device="cpu", precision="auto")
    with pytest.raises(InferenceError, match="expected boxes of positive size and scores from 0 to 1"):
        runtime(frame(), "rgb", -9.0)


def test_loading_and_running_leave_denormal_numbers_to_the_thread(runtime_name: str) -> None:
    loaded(runtime_name)(frame(), "rgb")
    assert not are_zero()


def test_a_graph_that_the_engine_cannot_run_is_told(runtime_name: str) -> None:
    with pytest.raises(InferenceError, match=f"{runtime_name} failed on cpu: "):
        loaded(runtime_name)(frame(0, (32, 32)), "rgb")


@pytest.mark.parametrize(
    ("wish", "told"),
    [
        pytest.param({"runtime": "torch"}, "Use runtime 'auto', 'onnxruntime' or 'openvino'", id="torch"),
        pytest.param({"precision": "int8"}, "Use precision 'auto', or the .pt", id="int8"),
        pytest.param({"precision": "fp16"}, "run as it is, this one in fp32", id="another precision"),
        pytest.param({"device": "cuda:0"}, "Use device 'cpu' or the .pt", id="GPU"),
    ],
)
def test_what_an_export_cannot_be_is_refused(wish: dict[str, str], told: str) -> None:
    wanted = {"runtime": "auto", "device": "auto", "precision": "auto"} | wish
    with pytest.raises(ValueError, match=told):
        load_export(read_onnx(small_export()), **wanted)


@pytest.mark.long  # torch exports a network of full size
@pytest.mark.parametrize("size", ["n", "n6"])
def test_an_export_predicts_what_the_official_network_predicts(size: str) -> None:
    expected = expected_predictions(size)
    height, width = expected.input_shape[2:]
    export = read_onnx(exported(formula_model(size).network(), size_hw=(height, width)))
    session = onnxruntime.InferenceSession(export.graph)
    outputs = session.run(None, {"images": formula_pixels(expected.input_shape).numpy()})
    expected.check(outputs[export.boxes][0])


@pytest.mark.long  # torch exports a network
@pytest.mark.parametrize(
    ("architecture", "options"),
    [
        pytest.param(SMALL, {"opset": 17}, id="opset 17"),
        pytest.param(SMALL, {"is_dynamic": True, "opset": 11}, id="dynamic, opset 11"),
        pytest.param(SMALL, {"is_half": True}, id="half"),
        pytest.param(SMALL_FAMILIES["segmentation"], {"is_dynamic": True}, id="dynamic segmentation"),
        pytest.param(SMALL_FAMILIES["ghost"], {}, id="another family"),
        pytest.param(RESIZED, {}, id="layers that change the size, of grey images"),
    ],
)
def test_an_export_predicts_what_its_network_predicts(
    runtime_name: str, architecture: Architecture, options: dict[str, Any]
) -> None:
    network = random_network(0, architecture).eval()
    export = read_onnx(exported(network, **options))
    pixels = frame(0, export.size_hw or SIZE_HW)
    pixels = pixels if export.channels == 3 else pixels[..., :1].repeat(3, axis=2)
    found = load_export(export, runtime_name, device="cpu", precision="auto")(pixels, "rgb")
    tolerance = 2e-2 if "is_half" in options else 1e-4
    with torch.inference_mode():
        planes = torch.from_numpy(pixels).permute(2, 0, 1)[None, : export.channels]
        features = network.features(planes / 255)
        rows = network.predictions(features)[0].numpy()
        np.testing.assert_allclose(found.rows, rows, rtol=tolerance, atol=tolerance)
        if isinstance(network.head, Segment):
            expected = network.head.proto(features[0])[0].numpy()
            np.testing.assert_allclose(prototypes(found), expected, rtol=tolerance, atol=tolerance)
