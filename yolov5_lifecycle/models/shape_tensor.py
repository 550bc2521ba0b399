"""Tensors of shapes alone, on which a network's own code is run to learn what it computes and allocates.

torch has such tensors, too, those on the meta device, but its first operation on one takes a second and
80 MB, for a package of algebra; and their sizes overflow where Python's integers do not.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch.nn import functional

Shape = tuple[int, ...]


@dataclass
class CostCounter:
    """What the operations on shapes amount to, in total and at once."""

    multiply_adds: int = 0
    elements: int = 0
    """Those of the tensors that exist now."""
    most_elements: int = 0
    layer: str = ""
    """What is computed now; set by whoever runs the network."""
    layer_of_most: str = ""

    def add(self, elements: int) -> None:
        self.elements += elements
        if self.elements > self.most_elements:
            self.most_elements, self.layer_of_most = self.elements, self.layer


class ShapeTensor:
    """A tensor of `shape` without elements; those it would have count as long as it or a view of it exists.

    torch's functions call those of `_FUNCTIONS` in place of their own code. Those without one, which no layer
    uses, raise NotImplementedError; ValueError if shapes do not fit.
    """

    dtype = torch.float32
    is_nested = False

    def __init__(self, shape: Shape, counter: CostCounter, of: ShapeTensor | None = None) -> None:
        self.shape = shape
        self.counter = counter
        self._of = of
        self._elements = math.prod(shape) if of is None else 0
        counter.add(self._elements)

    def __del__(self) -> None:
        self.counter.elements -= self._elements

    @classmethod
    def __torch_function__(
        cls,
        function: Callable[..., object],
        types: Sequence[type],
        args: Sequence[Any] = (),
        kwargs: Mapping[str, Any] | None = None,
    ) -> object:
        if function not in _FUNCTIONS:
            raise NotImplementedError(f"{function} of {cls.__name__}")
        return cls.called(function, *args, **(kwargs or {}))

    @classmethod
    def called(cls, function: Callable[..., object], *args: Any, **kwargs: Any) -> object:
        """The result of the `function` of torch."""
        return _FUNCTIONS[function](*args, **kwargs)

    def dim(self) -> int:
        return len(self.shape)

    def made(self, *shape: int, of: ShapeTensor | None = None) -> ShapeTensor:
        """Another tensor, with elements of its own unless it is a view `of` another."""
        return ShapeTensor(shape, self.counter, of)

    def __add__(self, other: ShapeTensor) -> ShapeTensor:
        if self.shape != other.shape:
            raise ValueError(f"features of the sizes {self.shape} and {other.shape} cannot be added")
        return self.made(*self.shape)

    def __getitem__(self, place: tuple[Any, ...]) -> ShapeTensor:
        """A view of rows or columns: an ellipsis and a slice of each of the last dimensions."""
        first = len(self.shape) - len(place) + 1
        cuts = (part.indices(side) for part, side in zip(place[1:], self.shape[first:], strict=True))
        kept = (-((start - stop) // step) for start, stop, step in cuts)  # range has no length of such sizes
        return self.made(*self.shape[:first], *kept, of=self)

    def permute(self, *order: int) -> ShapeTensor:
        """A copy: torch makes one when what is permuted is reshaped, as it always is."""
        return self.made(*(self.shape[dim] for dim in order))

    def reshape(self, *sizes: Any) -> ShapeTensor:
        shape = sizes[0] if isinstance(sizes[0], tuple) else sizes
        known = math.prod(size for size in shape if size != -1)
        inferred = math.prod(self.shape) // (known or 1)
        return self.made(*(inferred if size == -1 else size for size in shape), of=self)

    def view(self, *sizes: int) -> ShapeTensor:
        return self.reshape(*sizes)

    def flatten(self, start: int, end: int = -1) -> ShapeTensor:
        last = end % len(self.shape) + 1
        return self.reshape(*self.shape[:start], -1, *self.shape[last:])


def _convolved(features: ShapeTensor, weight: torch.Tensor, bias: object, *window: Any) -> ShapeTensor:
    """`window`: stride, padding, dilation and groups."""
    sides = _slid(features.shape[2:], tuple(weight.shape[2:]), *window[:3])
    made = features.made(features.shape[0], weight.shape[0], *sides)
    features.made(*weight.shape)  # torch sorts the weights for the processor in every run
    features.counter.multiply_adds += math.prod(made.shape) * math.prod(weight.shape[1:])
    return made


def _transposed(features: ShapeTensor, weight: torch.Tensor, bias: object, *window: Any) -> ShapeTensor:
    """`window`: stride, padding, output padding, groups and dilation, which no layer has."""
    stride, padding, more, groups, _ = window
    sides = (
        (side - 1) * step - 2 * pad + kernel + extra
        for side, kernel, step, pad, extra in zip(
            features.shape[2:], weight.shape[2:], stride, padding, more, strict=True
        )
    )
    features.counter.multiply_adds += math.prod(features.shape) * math.prod(weight.shape[1:])
    return features.made(features.shape[0], groups * weight.shape[1], *sides)


def _pooled(
    features: ShapeTensor, kernel: int, stride: int, padding: int = 0, dilation: int = 1, **_: object
) -> ShapeTensor:
    squares = ((side, side) for side in (kernel, stride, padding, dilation))
    pooled = features.made(*features.shape[:2], *_slid(features.shape[2:], *squares))
    pooled.made(2, *pooled.shape)  # torch also writes where each maximum is, in 64 bits, and drops that
    return pooled


def _slid(sides: Shape, kernel: Shape, stride: Shape, padding: Shape, dilation: Shape) -> list[int]:
    return [
        (side + 2 * pad - far * (window - 1) - 1) // step + 1
        for side, window, step, pad, far in zip(sides, kernel, stride, padding, dilation, strict=True)
    ]


def _resized(features: ShapeTensor, *, scale_factor: float, **_: object) -> ShapeTensor:
    return features.made(*features.shape[:2], *(side * int(scale_factor) for side in features.shape[2:]))


def _padded(features: ShapeTensor, pad: Shape, *_: object, **__: object) -> ShapeTensor:
    left, right, top, bottom = pad
    *outer, ny, nx = features.shape
    return features.made(*outer, ny + top + bottom, nx + left + right)


def _joined(features: Sequence[ShapeTensor], dim: int) -> ShapeTensor:
    first = features[0]
    if any(part.shape[2:] != first.shape[2:] for part in features):
        raise ValueError(f"{first.counter.layer} joins layers of different sizes")
    return first.made(first.shape[0], sum(part.shape[dim] for part in features), *first.shape[2:])


def _in_place(features: ShapeTensor, *_: object, **__: object) -> ShapeTensor:
    """Activations work in place, and every runtime folds a normalisation into the convolution before it."""
    return features


def _linear(features: ShapeTensor, weight: torch.Tensor, bias: object = None) -> ShapeTensor:
    made = features.made(*features.shape[:-1], weight.shape[0])
    features.counter.multiply_adds += math.prod(made.shape) * weight.shape[1]
    return made


def _attended(
    query: ShapeTensor,
    key: ShapeTensor,
    value: ShapeTensor,
    channels: int,
    heads: int,
    *_: object,
    **__: object,
) -> tuple[ShapeTensor, None]:
    """Attention of every cell to every cell, as written in ONNX; torch does not keep all pairs at once."""
    cells, batch, _channels = query.shape
    projected = [query.made(*query.shape) for _part in range(3)]
    shares = [query.made(batch, heads, cells, cells) for _step in ("products", "softmax")]
    mixed = query.made(*query.shape)
    query.counter.multiply_adds += cells * batch * channels * (4 * channels + 2 * cells)
    del projected, shares
    return mixed.made(*mixed.shape), None


_FUNCTIONS: Mapping[Callable[..., object], Callable[..., object]] = {
    torch.conv2d: _convolved,
    torch.conv_transpose2d: _transposed,
    **dict.fromkeys((torch.max_pool2d, functional.max_pool2d), _pooled),
    functional.interpolate: _resized,
    functional.pad: _padded,
    torch.cat: _joined,
    **dict.fromkeys((functional.batch_norm, functional.silu, functional.hardswish), _in_place),
    **dict.fromkeys((functional.leaky_relu, functional.relu), _in_place),
    functional.linear: _linear,
    functional.multi_head_attention_forward: _attended,
}
