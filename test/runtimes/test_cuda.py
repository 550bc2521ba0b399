"""torch on a GPU: recorded as a CUDA graph, and the same predictions as on the CPU."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from support.colcon_workspace import SUPPORT_PATH
from support.random_model import CLASS_NAMES, random_frame, random_model

from yolov5_lifecycle.images.image import ChannelOrder
from yolov5_lifecycle.process.memory import release_unused_memory
from yolov5_lifecycle.runtimes.torch_runtime import TorchRuntime

needs_cuda = pytest.mark.skipif(not torch.cuda.is_available(), reason="torch sees no CUDA device")


def on_cpu(seed: int, frame: NDArray[np.uint8], channel_order: ChannelOrder = "rgb") -> NDArray[np.float32]:
    return TorchRuntime.load(random_model(seed), device="cpu", precision="fp32")(frame, channel_order).rows


def on_cuda(seed: int, precision: str = "fp32") -> TorchRuntime:
    return TorchRuntime.load(random_model(seed), device="cuda", precision=precision)


@needs_cuda
@pytest.mark.parametrize(("precision", "scores", "boxes_px"), [("fp32", 2e-3, 0.1), ("fp16", 2e-2, 1.0)])
def test_cuda_predicts_what_the_cpu_predicts(precision: str, scores: float, boxes_px: float) -> None:
    runtime = on_cuda(2, precision)
    assert (runtime.device, runtime.precision) == ("cuda:0", precision)
    frame = random_frame(384, 640)
    for each in (frame, 255 - frame, frame):
        raw, expected = runtime(each, "bgr").rows, on_cpu(2, each, "bgr")
        assert raw.shape == (len(expected), 5 + len(CLASS_NAMES))
        np.testing.assert_allclose(raw[:, :4], expected[:, :4], rtol=1e-3, atol=boxes_px)
        np.testing.assert_allclose(raw[:, 4:], expected[:, 4:], rtol=0, atol=scores)


@needs_cuda
def test_on_cuda_earlier_predictions_stay_as_they_are_and_sizes_may_alternate() -> None:
    runtime = on_cuda(2)
    frames = [random_frame(64, width) for width in [*range(32, 225, 32), 32, 64]]
    frames += [255 - frame for frame in frames]
    predicted = [runtime(frame, "rgb").rows for frame in frames]
    for frame, raw in zip(frames, predicted, strict=True):
        np.testing.assert_allclose(raw, on_cpu(2, frame), rtol=2e-3, atol=2e-3)


@pytest.mark.skipif(torch.cuda.device_count() < 2, reason="torch sees no second CUDA device")
def test_a_second_gpu_records_what_it_predicts_itself() -> None:
    for device in ("cuda:0", "cuda:1"):
        runtime = TorchRuntime.load(random_model(2), device=device, precision="fp32")
        for frame in (random_frame(), 255 - random_frame()):
            np.testing.assert_allclose(runtime(frame, "rgb").rows, on_cpu(2, frame), rtol=2e-3, atol=2e-3)


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
                raw = on_cuda(2)(random_frame(), "rgb").rows
                np.testing.assert_allclose(raw, on_cpu(2, random_frame()), rtol=2e-3, atol=2e-3)
        finally:
            done.set()
        loading.result()
    assert "without a CUDA graph" not in caplog.text


@needs_cuda
def test_what_cuda_cannot_record_is_run_step_by_step_with_a_warning() -> None:
    """In a process of its own, as none is recorded after one that has failed."""
    program = """
import numpy as np, torch
from support.random_model import TINY, random_model
from yolov5_lifecycle.models.network import Network
from yolov5_lifecycle.runtimes.torch_runtime import TorchRuntime, prepared

class WaitingNetwork(Network):
    def forward(self, pixels):
        return super().forward(pixels) * float(torch.isfinite(pixels).all())

network = WaitingNetwork(TINY)
network.load_state_dict(random_model(2).state_dict)
device = torch.device("cuda:0")
runtime = TorchRuntime(prepared(network, device, torch.float32), device=device, dtype=torch.float32)
on_cpu = TorchRuntime.load(random_model(2), device="cpu", precision="fp32")
for grey in (50, 200):
    frame = np.full((64, 96, 3), grey, np.uint8)
    np.testing.assert_allclose(runtime(frame, "rgb").rows, on_cpu(frame, "rgb").rows, rtol=2e-3, atol=2e-3)
assert torch.cuda.current_stream() == torch.cuda.default_stream()
"""
    environment = os.environ | SUPPORT_PATH
    told = subprocess.run(
        [sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=False
    )
    assert told.returncode == 0, told.stderr
    assert told.stderr.count("runs without a CUDA graph, because capturing one failed: ") == 1


@needs_cuda
def test_closing_releases_the_memory_of_the_gpu() -> None:
    release_unused_memory()
    before = torch.cuda.memory_reserved()
    runtime = on_cuda(2)
    runtime(random_frame(384, 640), "rgb")
    assert torch.cuda.memory_reserved() > before
    runtime.close()
    release_unused_memory()
    assert torch.cuda.memory_reserved() <= before
