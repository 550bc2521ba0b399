"""Rounding to integers, and the rules for which network a set of ranges fits."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from support.random_model import random_model
from torch import nn

from yolov5_lifecycle.models.network import Network, fuse
from yolov5_lifecycle.quantization.activation_ranges import activations, most_sensitive
from yolov5_lifecycle.runtimes.processor import abilities, has_bf16, weight_bits
from yolov5_lifecycle.runtimes.quantization import (
    Activation,
    Quantization,
    QuantizationError,
    activation_step,
    convolutions,
    corrected_bias,
    quantized_weight,
)


@pytest.fixture(scope="module")
def network() -> Network:
    return fuse(random_model().network())


@pytest.fixture(scope="module")
def frames() -> list[torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    return [torch.rand((1, 3, 64, 96), generator=generator) for _ in range(3)]


@pytest.fixture(scope="module")
def read(network: Network, frames: list[torch.Tensor]) -> dict[str, Activation]:
    return activations(network, frames, progress=lambda _: None)


def test_every_convolution_but_those_of_the_last_layer_has_a_range(
    network: Network, read: dict[str, Activation]
) -> None:
    head = f"model.{len(network.model) - 1}."
    paths = {path for path, module in network.named_modules() if isinstance(module, nn.Conv2d)}
    assert read.keys() == {path for path in paths if not path.startswith(head)}
    assert all(each.range[0] <= 0 <= each.range[1] for each in read.values())
    assert {path: len(each.means) for path, each in read.items()} == {
        path: module.in_channels for path, module in convolutions(network).items()
    }


def test_the_first_convolution_reads_pixels(read: dict[str, Activation]) -> None:
    low, high = read["model.0.conv"].range
    assert low == 0.0
    assert high == pytest.approx(1.0, abs=0.1)
    assert read["model.0.conv"].means == pytest.approx((0.5, 0.5, 0.5), abs=0.02)


def test_observing_leaves_the_network_as_it_was(network: Network, frames: list[torch.Tensor]) -> None:
    before = network.features(frames[0])
    found = activations(network, frames, progress=lambda _: None)
    order = most_sensitive(network, found, torch.cat(frames), progress=lambda _: None)
    assert sorted(order) == sorted(found)
    after = network.features(frames[0])
    assert all(torch.equal(one, other) for one, other in zip(before, after, strict=True))


@pytest.mark.parametrize(("range_", "zero"), [((0.0, 2.0), 0), ((-1.0, 1.0), 128), ((-2.0, 0.0), 255)])
def test_zero_is_one_of_the_steps_of_an_activation(range_: tuple[float, float], zero: int) -> None:
    step, found = activation_step(range_)
    assert found == zero
    assert step * 255 == pytest.approx(range_[1] - range_[0])


@pytest.mark.parametrize(("bits", "largest"), [(8, 127), (7, 63)])
def test_each_output_channel_of_a_weight_has_its_own_step(bits: int, largest: int) -> None:
    weight = np.random.default_rng(0).normal(size=(4, 3, 3, 3)).astype(np.float32)
    weight[1] *= 1000
    weight[2] = 0
    integers, steps = quantized_weight(weight, bits)
    assert np.abs(integers).reshape(4, -1).max(axis=1).tolist() == [largest, largest, 0, largest]
    assert np.abs(integers * steps.reshape(-1, 1, 1, 1) - weight).max() <= steps.max() / 2 * 1.001


@pytest.mark.parametrize("groups", [1, 2])
def test_the_corrected_bias_keeps_the_mean_of_the_result(groups: int) -> None:
    torch.manual_seed(0)
    module = nn.Conv2d(4, 6, 1, groups=groups).requires_grad_(False)
    features = torch.rand(1, 4, 50, 50) + torch.arange(4).view(1, 4, 1, 1)
    exact = module(features).mean(dim=(0, 2, 3))
    assert module.bias is not None
    weight, means = module.weight.numpy(), features.mean(dim=(0, 2, 3)).tolist()
    integers, steps = quantized_weight(weight, 4)
    rounded = integers * steps.reshape(-1, 1, 1, 1)
    bias = corrected_bias(weight, module.bias.numpy(), rounded, means)
    module.weight.data, module.bias.data = torch.from_numpy(rounded), torch.from_numpy(bias)
    assert torch.allclose(module(features).mean(dim=(0, 2, 3)), exact, atol=1e-4)


def test_ranges_of_another_network_are_refused(network: Network, read: dict[str, Activation]) -> None:
    found = convolutions(network)
    Quantization.of(read).check(found)
    first, *_ = read
    missing = {name: each for name, each in read.items() if name != first}
    narrow = read | {first: Activation((0.0, 1.0), (0.5,))}
    for other, problem in (
        (missing, f"convolutions: {first}$"),
        (read | {"model.99.conv": read[first]}, r"convolutions: model\.99\.conv$"),
        (narrow, f"convolutions: {first}$"),
    ):
        with pytest.raises(QuantizationError, match=problem):
            Quantization.of(other).check(found)
    with pytest.raises(QuantizationError, match="convolutions: elsewhere"):
        Quantization.of(read, ["elsewhere"]).check(found)


@pytest.mark.parametrize(
    ("machine", "flags", "bits", "bf16"),
    [
        pytest.param("x86_64", "avx2 fma", 7, False, id="AVX2"),
        pytest.param("x86_64", "avx2 avx512f", 7, False, id="AVX-512"),
        pytest.param("x86_64", "avx2 avx_vnni", 8, False, id="AVX-VNNI"),
        pytest.param("x86_64", "avx2 avx512f avx512_vnni", 8, False, id="AVX512-VNNI"),
        pytest.param("x86_64", "avx512_vnni avx512_bf16", 8, True, id="AVX512-BF16"),
        pytest.param("x86_64", "amx_int8 amx_bf16", 8, True, id="AMX"),
        pytest.param("aarch64", "asimd asimddp", 8, False, id="ARM"),
    ],
)
def test_bits_of_weights_follow_what_the_processor_adds_without_overflow(
    machine: str, flags: str, bits: int, bf16: bool
) -> None:
    found = abilities(f"{machine}\nflags : fpu {flags}")
    assert set(found) == set(flags.split()) - {"fma", "asimd"}
    assert weight_bits(found, machine) == bits
    assert has_bf16(found) == bf16
