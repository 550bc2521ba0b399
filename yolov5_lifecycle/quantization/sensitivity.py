"""Which convolutions lose most in int8."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager

import torch
from torch import Tensor, nn

from yolov5_lifecycle.models.network import Network
from yolov5_lifecycle.runtimes.networks_by_shape import denormals_as_zero
from yolov5_lifecycle.runtimes.quantization import (
    LEVELS,
    Activation,
    activation_step,
    convolutions,
    corrected_bias,
    quantized_weight,
)


def most_sensitive(
    network: Network,
    activations: Mapping[str, Activation],
    frames: Tensor,
    *,
    weight_bits: int,
    progress: Callable[[int], None],
) -> list[str]:
    """Paths of all convolutions of the fused `network`: those first that change its features most.

    Each is computed in int8 alone, on `frames` (n, c, h, w), floats in [0, 1]. `progress` is given the number
    of convolutions done.
    """
    noise: dict[str, float] = {}
    with torch.no_grad(), denormals_as_zero():
        exact = network.features(frames)
        for number, (path, module) in enumerate(convolutions(network).items()):
            with _rounded(module, activations[path], weight_bits):
                noise[path] = _noise(network.features(frames), exact)
            progress(number + 1)
    return sorted(noise, key=lambda path: -noise[path])


def _noise(features: list[Tensor], exact: list[Tensor]) -> float:
    """The largest share of the difference in a level's energy."""
    return max(
        float((level - true).square().sum() / true.square().sum().clamp_min(1e-12))
        for level, true in zip(features, exact, strict=True)
    )


@contextmanager
def _rounded(module: nn.Conv2d, read: Activation, weight_bits: int) -> Iterator[None]:
    """Let `module` compute what it would in int8."""
    assert module.bias is not None
    weight, bias = module.weight.data, module.bias.data
    integers, steps = quantized_weight(weight.numpy(), weight_bits)
    rounded = integers * steps.reshape(-1, 1, 1, 1)
    module.bias.data = torch.from_numpy(corrected_bias(module, rounded, read.means))
    module.weight.data = torch.from_numpy(rounded)
    step, zero = activation_step(read.range)
    handle = module.register_forward_pre_hook(
        lambda _, inputs: torch.fake_quantize_per_tensor_affine(inputs[0], float(step), int(zero), 0, LEVELS)
    )
    try:
        yield
    finally:
        handle.remove()
        module.weight.data, module.bias.data = weight, bias
