"""Devices and precisions are resolved or refused; torch runs what the network is."""

from __future__ import annotations

import gc
import os
import subprocess
import sys
import threading
import weakref
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from support.colcon_workspace import SUPPORT_PATH
from support.random_model import CLASS_NAMES, TINY, random_model, random_network
from torch import Tensor

from yolov5_lifecycle.images.image import Order
from yolov5_lifecycle.models.network import Network
from yolov5_lifecycle.process.memory import release_unused_memory
from yolov5_lifecycle.runtimes.denormals import are_zero, denormals_as_zero
from yolov5_lifecycle.runtimes.runtime import InferenceError
from yolov5_lifecycle.runtimes.torch_device import (
    DeviceError,
    devices_present,
    resolve_device,
    resolve_precision,
)
from yolov5_lifecycle.runtimes.torch_runtime import TorchRuntime

CPU = torch.device("cpu")
needs_cuda = pytest.mark.skipif(not torch.cuda.is_available(), reason="torch sees no CUDA device")


def random_frame(height: int = 64, width: int = 96) -> NDArray[np.uint8]:
    return np.random.default_rng(0).integers(0, 256, (height, width, 3), np.uint8)


def runtime_of(network: Network) -> TorchRuntime:
    return TorchRuntime(network, device=CPU, dtype=torch.float32)


class FailingNetwork(Network):
    """Raises instead of predicting."""

    def __init__(self, error: Exception) -> None:
        super().__init__(TINY)
        self.error = error

    def forward(self, pixels: Tensor) -> Tensor:
        raise self.error


def test_cpu_is_always_there() -> None:
    assert resolve_device("cpu") == CPU
    assert devices_present()[0] == "cpu"


def test_auto_is_the_first_cuda_device_else_the_cpu() -> None:
    assert str(resolve_device("auto")) == ("cuda:0" if torch.cuda.is_available() else "cpu")


@pytest.mark.parametrize(
    ("word", "name"),
    [("cuda:99", "cuda:99"), ("99", "cuda:99"), ("cuda:099", "cuda:99"), ("cuda", "cuda:0"), ("mps", "mps")],
)
def test_an_absent_device_is_refused_with_what_there_is(word: str, name: str) -> None:
    if name in devices_present():
        assert str(resolve_device(word)) == name
        return
    with pytest.raises(DeviceError, match=f"Device '{name}' is absent: torch .* sees cpu.*Use one of these"):
        resolve_device(word)


@pytest.mark.parametrize(
    "word", ["", "gpu", "cuda:", "cuda:x", "cuda:-1", "cuda:1:2", "-1", "1.0", "cpu:0", "²", "9" * 30, "meta"]
)
def test_another_word_is_no_device(word: str) -> None:
    with pytest.raises(DeviceError, match="must be auto, cpu, cuda, cuda:N, N or mps, found"):
        resolve_device(word)


@pytest.mark.parametrize(
    ("precision", "device", "dtype"),
    [
        ("auto", "cpu", torch.float32),
        ("auto", "cuda:1", torch.float16),
        ("auto", "mps", torch.float32),
        ("fp32", "cpu", torch.float32),
        ("fp32", "cuda", torch.float32),
        ("fp16", "cuda", torch.float16),
        ("fp16", "mps", torch.float16),
    ],
)
def test_precision_is_resolved_for_the_device(precision: str, device: str, dtype: torch.dtype) -> None:
    assert resolve_precision(precision, torch.device(device)) == dtype


@pytest.mark.parametrize(
    ("precision", "reason"), [("fp16", "needs a GPU"), ("half", "must be auto, fp32 or fp16")]
)
def test_a_precision_that_cannot_be_is_refused(precision: str, reason: str) -> None:
    with pytest.raises(DeviceError, match=reason):
        resolve_precision(precision, CPU)


@pytest.mark.parametrize("size_hw", [(64, 96), (32, 32), (160, 64)], ids=str)
def test_predictions_are_those_of_the_network_as_it_was_trained(size_hw: tuple[int, int]) -> None:
    frame = random_frame(*size_hw)
    pixels = torch.from_numpy(frame).permute(2, 0, 1)[None] / 255
    with torch.inference_mode():
        expected = random_network(5)(pixels)[0].numpy()
    raw = TorchRuntime.load(random_model(5), device="cpu", precision="auto")(frame, "rgb")
    assert raw.dtype == np.float32
    np.testing.assert_allclose(raw, expected, rtol=1e-3, atol=1e-3)


def test_loading_leaves_the_model_as_it_was() -> None:
    model, untouched = random_model(3), random_model(3)
    runtime = TorchRuntime.load(model, device="cpu", precision="fp32")
    runtime(random_frame(), "rgb")
    for key, tensor in untouched.state_dict.items():
        assert torch.equal(model.state_dict[key], tensor), key


def test_what_was_resolved_can_be_read() -> None:
    runtime = TorchRuntime.load(random_model(), device="cpu", precision="auto")
    assert (runtime.name, runtime.device, runtime.precision) == ("torch", "cpu", "fp32")


def test_an_absent_device_is_refused_by_loading() -> None:
    with pytest.raises(DeviceError, match="absent"):
        TorchRuntime.load(random_model(), device="cuda:99", precision="auto")


def test_closing_frees_the_network_and_may_be_repeated() -> None:
    network = random_network(0)
    freed = weakref.ref(network)
    runtime = runtime_of(network)
    runtime(random_frame(), "rgb")
    del network
    runtime.close()
    runtime.close()
    gc.collect()
    assert freed() is None


@pytest.mark.parametrize(
    ("error", "message"),
    [
        pytest.param(
            RuntimeError("mat1 and mat2\nException raised from ..."),
            "failed on cpu: mat1 and mat2$",
            id="any",
        ),
        pytest.param(torch.OutOfMemoryError("Tried to allocate 2 GiB."), "2 GiB. Use a smaller", id="memory"),
        pytest.param(
            torch.AcceleratorError("CUDA error: launch failure"), "launch failure$", id="accelerator"
        ),
    ],
)
def test_what_torch_raises_is_told_in_one_line_and_keeps_nothing_alive(
    error: Exception, message: str
) -> None:
    runtime = runtime_of(FailingNetwork(error))
    with pytest.raises(InferenceError, match=message) as failure:
        runtime(random_frame(), "rgb")
    assert failure.value.__context__ is None


def test_a_mistake_in_the_program_is_not_hidden() -> None:
    with pytest.raises(TypeError, match="mistake"):
        runtime_of(FailingNetwork(TypeError("mistake")))(random_frame(), "rgb")


def on_cpu(seed: int, frame: NDArray[np.uint8], order: Order = "rgb") -> NDArray[np.float32]:
    return TorchRuntime.load(random_model(seed), device="cpu", precision="fp32")(frame, order)


def on_cuda(seed: int, precision: str = "fp32") -> TorchRuntime:
    return TorchRuntime.load(random_model(seed), device="cuda", precision=precision)


def test_predictions_depend_on_the_picture_by_more_than_what_a_gpu_may_deviate() -> None:
    frame = random_frame()
    for other in (frame[..., ::-1].copy(), np.zeros_like(frame)):
        assert np.abs(on_cpu(2, frame)[:, 4:] - on_cpu(2, other)[:, 4:]).max() > 5e-3


@needs_cuda
@pytest.mark.parametrize(("precision", "scores", "boxes_px"), [("fp32", 2e-3, 0.1), ("fp16", 2e-2, 1.0)])
def test_cuda_predicts_what_the_cpu_predicts(precision: str, scores: float, boxes_px: float) -> None:
    runtime = on_cuda(2, precision)
    assert (runtime.device, runtime.precision) == ("cuda:0", precision)
    frame = random_frame(384, 640)
    for each in (frame, 255 - frame, frame):
        raw, expected = runtime(each, "bgr"), on_cpu(2, each, "bgr")
        assert raw.shape == (len(expected), 5 + len(CLASS_NAMES))
        np.testing.assert_allclose(raw[:, :4], expected[:, :4], rtol=1e-3, atol=boxes_px)
        np.testing.assert_allclose(raw[:, 4:], expected[:, 4:], rtol=0, atol=scores)


@needs_cuda
def test_on_cuda_earlier_predictions_stay_as_they_are_and_sizes_may_alternate() -> None:
    runtime = on_cuda(2)
    frames = [random_frame(64, width) for width in [*range(32, 225, 32), 32, 64]]
    frames += [255 - frame for frame in frames]
    predicted = [runtime(frame, "rgb") for frame in frames]
    for frame, raw in zip(frames, predicted, strict=True):
        np.testing.assert_allclose(raw, on_cpu(2, frame), rtol=2e-3, atol=2e-3)


@pytest.mark.skipif(torch.cuda.device_count() < 2, reason="torch sees no second CUDA device")
def test_a_second_gpu_records_what_it_predicts_itself() -> None:
    for device in ("cuda:0", "cuda:1"):
        runtime = TorchRuntime.load(random_model(2), device=device, precision="fp32")
        for frame in (random_frame(), 255 - random_frame()):
            np.testing.assert_allclose(runtime(frame, "rgb"), on_cpu(2, frame), rtol=2e-3, atol=2e-3)


@needs_cuda
def test_cuda_records_while_another_model_is_loaded_and_recorded(caplog: pytest.LogCaptureFixture) -> None:
    done = threading.Event()

    def load_again_and_again() -> None:
        while not done.is_set():
            on_cuda(3)(random_frame(32, 32), "rgb")

    with ThreadPoolExecutor() as pool:
        loading = pool.submit(load_again_and_again)
        try:
            for _ in range(20):
                raw = on_cuda(2)(random_frame(), "rgb")
                np.testing.assert_allclose(raw, on_cpu(2, random_frame()), rtol=2e-3, atol=2e-3)
        finally:
            done.set()
        loading.result()
    assert "step by step" not in caplog.text


@needs_cuda
def test_what_cuda_cannot_record_is_run_step_by_step_with_a_warning() -> None:
    """In a process of its own, as none is recorded after one that has failed."""
    program = """
import numpy as np, torch
from support.random_model import TINY, random_model
from yolov5_lifecycle.models.network import Network
from yolov5_lifecycle.runtimes.torch_runtime import TorchRuntime

class WaitingNetwork(Network):
    def forward(self, pixels):
        return super().forward(pixels) * float(torch.isfinite(pixels).all())

network = WaitingNetwork(TINY)
network.load_state_dict(random_model(2).state_dict)
runtime = TorchRuntime(network, device=torch.device("cuda:0"), dtype=torch.float32)
on_cpu = TorchRuntime.load(random_model(2), device="cpu", precision="fp32")
for grey in (50, 200):
    frame = np.full((64, 96, 3), grey, np.uint8)
    np.testing.assert_allclose(runtime(frame, "rgb"), on_cpu(frame, "rgb"), rtol=2e-3, atol=2e-3)
assert torch.cuda.current_stream() == torch.cuda.default_stream()
"""
    environment = os.environ | SUPPORT_PATH
    told = subprocess.run(
        [sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=False
    )
    assert told.returncode == 0, told.stderr
    assert told.stderr.count("run step by step, as CUDA could not record it: ") == 1


@needs_cuda
def test_closing_gives_the_memory_of_the_gpu_back() -> None:
    release_unused_memory()
    before = torch.cuda.memory_reserved()
    runtime = on_cuda(2)
    runtime(random_frame(384, 640), "rgb")
    assert torch.cuda.memory_reserved() > before
    runtime.close()
    release_unused_memory()
    assert torch.cuda.memory_reserved() <= before


def test_a_thread_that_took_denormal_numbers_for_zero_does_so_afterwards() -> None:
    torch.set_flush_denormal(True)
    try:
        with denormals_as_zero():
            assert are_zero()
        assert are_zero()
    finally:
        torch.set_flush_denormal(False)
