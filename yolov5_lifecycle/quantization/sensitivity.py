"""Which convolutions lose most in int8, relative to their cost in fp32."""

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
    """Paths of all convolutions of the fused `network`, the most sensitive one first.

    A convolution is sensitive if int8 changes the features much for each of its multiplications. With these
    in fp32, yolov5n agreed as well as with those that change the features most, for half the multiplications
    in fp32.

    Each is computed in int8 alone, on `frames` (n, c, h, w), floats in [0, 1]. `progress` is given the number
    of convolutions done.
    """
    noise: dict[str, float] = {}
    with torch.no_grad(), denormals_as_zero():
        with _counted(network) as products:
            exact = network.features(frames)
        for number, (path, module) in enumerate(convolutions(network).items()):
            with _rounded(module, activations[path], weight_bits):
                noise[path] = _noise(network.features(frames), exact)
            progress(number + 1)
    return sorted(noise, key=lambda path: -noise[path] / products[path])


@contextmanager
def _counted(network: Network) -> Iterator[dict[str, int]]:
    """The multiplications of each convolution for one image, counted while the network runs."""
    products: dict[str, int] = {}

    def count(path: str, module: nn.Module, result: Tensor) -> None:
        assert isinstance(module, nn.Conv2d)
        products[path] = result[0, 0].numel() * module.weight.numel()

    handles = [
        module.register_forward_hook(lambda module, _, result, path=path: count(path, module, result))
        for path, module in convolutions(network).items()
    ]
    try:
        yield products
    finally:
        for handle in handles:
            handle.remove()


def _noise(features: list[Tensor], exact: list[Tensor]) -> float:
    """The largest share of the difference in a level's energy."""
    return max(
        float((level - true).square().sum() / true.square().sum().clamp_min(1e-12))
        for level, true in zip(features, exact, strict=True)
    )


@contextmanager
def _rounded(module: nn.Conv2d, read: Activation, weight_bits: int) -> Iterator[None]:
    """Let `module` compute as if in int8."""
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
