"""The steps in which a network computes its features, in one form for networks and for exported graphs."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from yolov5_lifecycle.models.head import Segment
from yolov5_lifecycle.models.network import Network
from yolov5_lifecycle.models.tensor_stand_in import TensorStandIn

PIXELS = "pixels"
ACTIVATION = "activation"
"""The step of an activation of any kind; its setting is the path of its module."""


class Step(NamedTuple):
    """An operation of `kind` with numbers as `settings`, on the outputs of `inputs`.

    `tensors` are the keys of its weights in a state dict, or the names of their arrays in a file. `inputs`
    are steps, or in a graph the names of values.
    """

    kind: str
    settings: tuple[Any, ...] = ()
    inputs: tuple[Any, ...] = ()
    tensors: tuple[str, ...] = ()


def pooled(below: Step | None, features: object, kernel: int, stride: int, padding: int) -> Step:
    """A max-pool of `features`, which `below` makes.

    One at stride 1 of another is one with a larger window: SPPF computes the windows of SPP in this way.
    """
    is_second = below is not None and below.kind == "max-pool" and _keeps_size(*below.settings)
    if below is not None and is_second and _keeps_size(kernel, stride, padding):
        kernel += below.settings[0] - 1
        return Step("max-pool", (kernel, 1, kernel // 2), below.inputs)
    return Step("max-pool", (kernel, stride, padding), (features,))


def _keeps_size(kernel: int, stride: int, padding: int) -> bool:
    return kernel % 2 == 1 and stride == 1 and padding == kernel // 2


def sliced(below: Step | None, features: object, slices: Mapping[int, tuple[int, int]]) -> Step:
    """Every so many cells of `features`, which `below` makes: first and step by dimension."""
    if below is not None and below.kind == "slice" and not below.settings[0].keys() & slices.keys():
        return Step("slice", (dict(below.settings[0]) | dict(slices),), below.inputs)
    return Step("slice", (dict(slices),), (features,))


def same_settings(found: tuple[Any, ...], expected: tuple[Any, ...]) -> bool:
    """Equality, for floats that a file holds in single precision up to rounding."""
    return len(found) == len(expected) and all(map(_same, found, expected))


def _same(found: object, expected: object) -> bool:
    if isinstance(found, float) and isinstance(expected, float):
        return math.isclose(found, expected, rel_tol=1e-5)
    return found == expected


def head_steps(network: Network) -> tuple[list[Step], Step | None]:
    """The last convolution of each level, and the prototypes of a network that segments.

    Activations are steps of kind ACTIVATION whatever they are in `network`, which is left without them.
    """
    for path, module in list(network.named_modules()):
        if isinstance(getattr(module, "act", None), nn.Module):
            module.act = _AnyActivation(f"{path}.act")
    keys = {id(tensor): key for key, tensor in network.state_dict(keep_vars=True).items()}
    features: list[Any] = network.features(_Traced(Step(PIXELS), keys))  # type: ignore[arg-type]
    levels = [convolution(level).step for convolution, level in zip(network.head.m, features, strict=True)]
    is_segment = isinstance(network.head, Segment)
    return levels, network.head.proto(features[0]).step if is_segment else None  # type: ignore[operator]


class _AnyActivation(nn.Module):
    def __init__(self, path: str) -> None:
        super().__init__()
        self._path = path

    def forward(self, features: Any) -> Any:
        return features.after(Step(ACTIVATION, (self._path,), (features.step,)))


class _Traced(TensorStandIn):
    """The output of a step; torch's functions make the next one of it."""

    def __init__(self, step: Step, keys: Mapping[int, str]) -> None:
        self.step = step
        self.keys = keys

    def dim(self) -> int:
        return 4

    def after(self, step: Step) -> _Traced:
        return _Traced(step, self.keys)

    def keys_of(self, *tensors: Tensor | None) -> tuple[str, ...]:
        return tuple(self.keys[id(tensor)] for tensor in tensors if tensor is not None)

    def __add__(self, other: _Traced) -> _Traced:
        return self.after(Step("add", (), (self.step, other.step)))

    def __getitem__(self, place: tuple[Any, ...]) -> _Traced:
        _, *slices = place
        first = 4 - len(slices)
        parts = {
            first + index: (part.start, part.step) for index, part in enumerate(slices) if part != slice(None)
        }
        return self.after(sliced(self.step, self.step, parts))


def _convolved(
    features: _Traced,
    weight: Tensor,
    bias: Tensor | None,
    stride: tuple[int, ...],
    padding: tuple[int, ...],
    dilation: tuple[int, ...],
    groups: int,
) -> _Traced:
    settings = (tuple(stride), tuple(padding) * 2, tuple(dilation), groups)
    return features.after(Step("conv", settings, (features.step,), features.keys_of(weight, bias)))


def _normalised(
    features: _Traced,
    mean: Tensor,
    variance: Tensor,
    weight: Tensor,
    bias: Tensor,
    *,
    eps: float,
    **_: object,
) -> _Traced:
    tensors = features.keys_of(weight, bias, mean, variance)
    return features.after(Step("normalisation", (eps,), (features.step,), tensors))


def _pooled(
    features: _Traced, kernel: int, stride: int, padding: int = 0, *_: object, **__: object
) -> _Traced:
    return features.after(pooled(features.step, features.step, kernel, stride, padding))


def _joined(features: Sequence[_Traced], dim: int) -> _Traced:
    return features[0].after(Step("concat", (), tuple(part.step for part in features)))


def _resized(features: _Traced, **_: object) -> _Traced:
    return features.after(Step("upsample", (), (features.step,)))


def _padded(features: _Traced, pad: tuple[int, ...], *_: object, **__: object) -> _Traced:
    return features.after(Step("pad", (tuple(pad),), (features.step,)))


_Traced.functions = {
    torch.conv2d: _convolved,
    torch.max_pool2d: _pooled,
    functional.max_pool2d: _pooled,
    functional.interpolate: _resized,
    functional.pad: _padded,
    torch.cat: _joined,
    functional.batch_norm: _normalised,
}
