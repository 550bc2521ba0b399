"""What int8 needs to know: the ranges that convolutions read, without outliers, and which lose most in it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from yolov5_lifecycle.images.image import ChannelOrder
from yolov5_lifecycle.models.network import Network
from yolov5_lifecycle.runtimes.networks_by_shape import denormals_as_zero
from yolov5_lifecycle.runtimes.processor import abilities, weight_bits
from yolov5_lifecycle.runtimes.quantization import (
    LEVELS,
    Activation,
    Range,
    activation_step,
    convolutions,
    corrected_bias,
    quantized_weight,
)

BINS = 2048
_FIRST_LOOK = 16
"""Images after which the limits of the histograms are set."""
_MARGIN = 0.25
_SAMPLED = 3
"""Every third value is counted."""
_KEPT_SHARES = np.linspace(0.15, 1.0, 35)
_SMALLEST_WIDTH = 1e-3


class _Histogram:
    """Values of one activation: how many in each of BINS around the range `seen`, and sums by channel."""

    def __init__(self, seen: Range) -> None:
        """Values beyond the limits, which are somewhat beyond `seen`, count as the outermost ones."""
        self._seen_low, self._seen_high = seen
        margin = max(_MARGIN * (self._seen_high - self._seen_low), _SMALLEST_WIDTH)
        self._low = self._seen_low - margin
        self._width = (self._seen_high + margin - self._low) / BINS
        self._counts = np.zeros(BINS, np.int64)
        self._sums: NDArray[np.float64] = np.zeros(1)
        self._frames = 0

    def count(self, values: Tensor) -> None:
        sample = values.flatten()[::_SAMPLED]
        bins = ((sample - self._low) * (1 / self._width)).clamp_(0, BINS - 1).to(torch.int32)
        self._counts += torch.bincount(bins, minlength=BINS).numpy()
        self._sums = self._sums + values.mean(dim=(0, 2, 3)).double().numpy()
        self._frames += 1

    def activation(self) -> Activation:
        """The range, and the mean of each channel."""
        means = self._sums / self._frames
        return Activation(self.range(), tuple(float(f"{mean:.5g}") for mean in means))

    def range(self) -> Range:
        """The range with the smallest mean squared error after rounding; 0 lies in it."""
        occupied = np.flatnonzero(self._counts)
        centres = np.asarray(self._low + (occupied + 0.5) * self._width, np.float64)
        counts = self._counts[occupied]
        # Values below 0 are few bits of a range after SiLU, yet most of its values: never cut off there.
        lows = self._seen_low * (_KEPT_SHARES if -self._seen_low > 0.5 * self._seen_high else np.ones(1))
        candidates = [(float(low), float(self._seen_high * share)) for low in lows for share in _KEPT_SHARES]
        usable = [pair for pair in candidates if pair[1] - pair[0] >= _SMALLEST_WIDTH]
        errors = [_squared_error(pair, centres, counts) for pair in usable]
        low, high = usable[int(np.argmin(errors))] if usable else (0.0, 1.0)
        return float(f"{low:.6g}"), float(f"{high:.6g}")


def _squared_error(range_: Range, values: NDArray[np.float64], counts: NDArray[np.int64]) -> float:
    low, high = range_
    step = (high - low) / LEVELS
    rounded = np.clip(np.rint((values - low) / step), 0, LEVELS) * step + low
    return float((counts * (rounded - values) ** 2).sum())


def activations(
    network: Network, frames: Sequence[Tensor], *, progress: Callable[[int], None]
) -> dict[str, Activation]:
    """What each convolution of the fused `network` reads, by its path.

    `frames`: (1, c, h, w) each, floats in [0, 1]. `progress` is given the number of frames done.
    """
    found = convolutions(network)
    seen: dict[str, Range] = dict.fromkeys(found, (0.0, 0.0))

    def look(path: str, values: Tensor) -> None:
        low, high = (float(value) for value in values.aminmax())
        seen[path] = min(seen[path][0], low), max(seen[path][1], high)

    for frame in frames[:: max(1, len(frames) // _FIRST_LOOK)]:
        _observe(network, frame, {module: partial(look, path) for path, module in found.items()})
    histograms = {path: _Histogram(range_) for path, range_ in seen.items()}
    for number, frame in enumerate(frames):
        _observe(network, frame, {found[path]: each.count for path, each in histograms.items()})
        progress(number + 1)
    return {path: histogram.activation() for path, histogram in histograms.items()}


def network_pixels(pixels: NDArray[np.uint8], channel_order: ChannelOrder, channels: int) -> Tensor:
    """(1, channels, h, w), floats in [0, 1], as the network reads them; `pixels`: (h, w, 3) or (h, w)."""
    from yolov5_lifecycle.runtimes.compiled_runtime import write_planes  # its package is optional

    planes: NDArray[np.uint8] = np.empty((channels, *pixels.shape[:2]), np.uint8)
    write_planes(pixels, channel_order, planes)
    return torch.from_numpy(planes)[None].float() / 255


def _observe(
    network: Network, frame: Tensor, observers: Mapping[nn.Conv2d, Callable[[Tensor], None]]
) -> None:
    """Give each observer what its convolution reads of `frame`."""
    with ExitStack() as hooks, torch.no_grad(), denormals_as_zero():
        for module, observe in observers.items():
            hooks.enter_context(
                module.register_forward_pre_hook(lambda _, inputs, observe=observe: observe(inputs[0]))
            )
        network.features(frame)


def most_sensitive(
    network: Network,
    activations: Mapping[str, Activation],
    frames: Tensor,
    *,
    progress: Callable[[int], None],
) -> list[str]:
    """Paths of all convolutions of the fused `network`, the most sensitive one first.

    A convolution is sensitive if int8 changes the features much for each of its multiplications. With these
    in fp32, yolov5n agreed as well as with those that change the features most, for half the multiplications
    in fp32.

    Each is computed in int8 alone, on `frames` (n, c, h, w), floats in [0, 1]. `progress` is given the number
    of convolutions done.
    """
    found = convolutions(network)
    noise: dict[str, float] = {}
    products: dict[str, int] = {}

    def count(path: str, module: nn.Conv2d, _: object, result: Tensor) -> None:
        products[path] = result[0, 0].numel() * module.weight.numel()

    with torch.no_grad(), denormals_as_zero():
        with ExitStack() as hooks:
            for path, module in found.items():
                hooks.enter_context(module.register_forward_hook(partial(count, path)))
            exact = network.features(frames)
        for number, (path, module) in enumerate(found.items()):
            with _rounded(module, activations[path]):
                noise[path] = _noise(network.features(frames), exact)
            progress(number + 1)
    return sorted(noise, key=lambda path: -noise[path] / products[path])


def _noise(features: list[Tensor], exact: list[Tensor]) -> float:
    """The largest share of the difference in a level's energy."""
    return max(
        float((level - true).square().sum() / true.square().sum().clamp_min(1e-12))
        for level, true in zip(features, exact, strict=True)
    )


@contextmanager
def _rounded(module: nn.Conv2d, read: Activation) -> Iterator[None]:
    """Let `module` compute as if in int8."""
    assert module.bias is not None
    weight, bias = module.weight.data, module.bias.data
    integers, steps = quantized_weight(weight.numpy(), weight_bits(abilities()))
    rounded = integers * steps.reshape(-1, 1, 1, 1)
    module.bias.data = torch.from_numpy(corrected_bias(weight.numpy(), bias.numpy(), rounded, read.means))
    module.weight.data = torch.from_numpy(rounded)
    step, zero = activation_step(read.range)
    hook = module.register_forward_pre_hook(
        lambda _, inputs: torch.fake_quantize_per_tensor_affine(inputs[0], float(step), int(zero), 0, LEVELS)
    )
    try:
        with hook:
            yield
    finally:
        module.weight.data, module.bias.data = weight, bias
