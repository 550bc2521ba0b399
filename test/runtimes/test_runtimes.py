"""Devices, precisions and the runtime of torch on the CPU."""

from __future__ import annotations

import gc
import weakref

import pytest
import torch
from support.random_model import TINY, random_frame, random_model, random_network
from torch import Tensor

from yolov5_lifecycle.models.network import Network
from yolov5_lifecycle.runtimes.runtime import InferenceError
from yolov5_lifecycle.runtimes.torch_device import (
    DeviceError,
    devices_present,
    resolve_device,
    resolve_precision,
)
from yolov5_lifecycle.runtimes.torch_runtime import TorchRuntime, prepared

CPU = torch.device("cpu")


def runtime_of(network: Network) -> TorchRuntime:
    return TorchRuntime(prepared(network, CPU, torch.float32), device=CPU, dtype=torch.float32)


class FailingNetwork(Network):
    """Raises instead of predicting."""

    def __init__(self, error: Exception) -> None:
        super().__init__(TINY)
        self.error = error

    def features(self, pixels: Tensor) -> list[Tensor]:
        raise self.error


def test_auto_is_the_first_cuda_device_else_the_cpu_which_is_always_there() -> None:
    assert resolve_device("cpu") == CPU
    assert devices_present()[0] == "cpu"
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


@pytest.mark.parametrize("word", ["", "gpu", "cuda:", "cuda:-1", "1.0", "cpu:0", "²", "9" * 30, "meta"])
def test_another_word_is_no_device(word: str) -> None:
    with pytest.raises(DeviceError, match="must be auto, cpu, cuda, cuda:N, N or mps, found"):
        resolve_device(word)


@pytest.mark.parametrize(
    ("precision", "device", "dtype"),
    [
        ("auto", "cpu", torch.float32),
        ("auto", "cuda:1", torch.float16),
        ("auto", "mps", torch.float32),
        ("fp32", "cuda", torch.float32),
        ("fp16", "cuda", torch.float16),
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


def test_loading_leaves_the_model_as_it_was() -> None:
    model, untouched = random_model(3), random_model(3)
    runtime = TorchRuntime.load(model, device="cpu", precision="fp32")
    runtime(random_frame(), "rgb")
    for key, tensor in untouched.state_dict.items():
        assert torch.equal(model.state_dict[key], tensor), key


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
def test_an_error_of_torch_is_one_line_and_keeps_nothing_alive(error: Exception, message: str) -> None:
    runtime = runtime_of(FailingNetwork(error))
    with pytest.raises(InferenceError, match=message) as failure:
        runtime(random_frame(), "rgb")
    assert failure.value.__context__ is None


def test_a_mistake_in_the_program_is_not_hidden() -> None:
    with pytest.raises(TypeError, match="mistake"):
        runtime_of(FailingNetwork(TypeError("mistake")))(random_frame(), "rgb")
