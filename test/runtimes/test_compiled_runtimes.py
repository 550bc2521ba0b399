"""ONNX Runtime and OpenVINO predict what torch predicts, for every size, and free all memory on close."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from numpy.typing import NDArray
from support.colcon_workspace import REPOSITORY
from support.random_model import TINY, random_frame, random_model
from support.runtime_names import COMPILED_RUNTIMES
from support.started import printed_by

from yolov5_lifecycle.models.architecture import Architecture, Layer
from yolov5_lifecycle.models.model import Model
from yolov5_lifecycle.runtimes.registry import load_runtime
from yolov5_lifecycle.runtimes.runtime import Runtime
from yolov5_lifecycle.runtimes.torch_device import DeviceError

DETECT_ALONE = dataclasses.replace(
    TINY, anchors_px=(((10, 13), (16, 30)),), strides=(1,), layers=(Layer((-1,), 1, "Detect"),)
)
PIXELS_TWICE = dataclasses.replace(
    DETECT_ALONE,
    strides=(2,),
    layers=(Layer((-1, -1), 1, "Concat"), Layer((-1,), 1, "Conv", (64, 3, 2)), Layer((-1,), 1, "Detect")),
)
SCORES = 2e-3
BOXES_PX = 0.1


@pytest.fixture(params=COMPILED_RUNTIMES)
def runtime_name(request: pytest.FixtureRequest) -> str:
    return str(request.param)


def loaded(model: Model, runtime: str) -> Runtime:
    return load_runtime(model, runtime, device="cpu", precision="fp32")


def assert_same_predictions(raw: NDArray[np.float32], expected: NDArray[np.float32]) -> None:
    assert raw.shape == expected.shape
    assert raw.dtype == np.float32
    np.testing.assert_allclose(raw[:, :4], expected[:, :4], rtol=0, atol=BOXES_PX)
    np.testing.assert_allclose(raw[:, 4:], expected[:, 4:], rtol=0, atol=SCORES)


@pytest.mark.long
@pytest.mark.parametrize(
    "architecture",
    [
        pytest.param(DETECT_ALONE, id="no layer but the last"),
        pytest.param(PIXELS_TWICE, id="a first layer that joins the image with itself"),
    ],
)
def test_a_random_network_predicts_what_it_predicts_in_torch(
    runtime_name: str, architecture: Architecture
) -> None:
    model, frame = random_model(4, architecture), random_frame(192, 64)
    raw, expected = (loaded(model, name)(frame, "rgb").rows for name in (runtime_name, "torch"))
    assert_same_predictions(raw, expected)


@pytest.mark.long
def test_sizes_may_alternate_without_end(runtime_name: str) -> None:
    model = random_model(2)
    runtime, torch_runtime = loaded(model, runtime_name), loaded(model, "torch")
    for width in [*range(32, 257, 32), 32, 64]:
        frame = random_frame(64, width)
        assert_same_predictions(runtime(frame, "rgb").rows, torch_runtime(frame, "rgb").rows)


def test_a_gpu_or_half_numbers_are_refused(runtime_name: str) -> None:
    with pytest.raises(DeviceError, match=f"'{runtime_name}' runs on the CPU only, found device 'cuda:0'"):
        load_runtime(random_model(), runtime_name, device="cuda:0", precision="auto")
    with pytest.raises(DeviceError, match="needs a GPU"):
        load_runtime(random_model(), runtime_name, device="auto", precision="fp16")


AFTER_MODELS = """
import gc, os, signal
from yolov5_lifecycle import load_model
signal.signal(signal.SIGUSR1, lambda *_: print("handled"))
one, other = (load_model({weights!r}, runtime={runtime!r}) for _ in range(2))
del one
gc.collect()
del other
gc.collect()
os.kill(os.getpid(), signal.SIGUSR1)
"""


@pytest.mark.long
def test_a_signal_is_handled_after_models_were_freed_in_any_order(runtime_name: str) -> None:
    weights = str(REPOSITORY / "weights" / "shapes.safetensors")
    assert printed_by(AFTER_MODELS.format(weights=weights, runtime=runtime_name)) == "handled\n"
