"""Tensors without numbers, on which a network's own code is run to learn what it would compute and allocate.

torch has such tensors, too, those on the meta device, but its first operation on one takes a second and
80 MB, for a package of algebra; and their sizes overflow where Python's integers do not.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch.nn import functional

from yolov5_lifecycle.models.tensor_stand_in import TensorStandIn

Shape = tuple[int, ...]


@dataclass
class Ledger:
    """What the operations on outlines amount to, in total and at once."""

    multiply_adds: int = 0
    elements: int = 0
    """Those of the outlines that exist now."""
    most_elements: int = 0
    layer: str = ""
    """What is computed now; set by whoever runs the network."""
    layer_of_most: str = ""

    def add(self, elements: int) -> None:
        self.elements += elements
        if self.elements > self.most_elements:
            self.most_elements, self.layer_of_most = self.elements, self.layer


class _Allocation:
    """Elements that are kept as long as an outline refers to them."""

    def __init__(self, ledger: Ledger, elements: int) -> None:
        self.ledger = ledger
        self._elements = elements
        ledger.add(elements)

    def __del__(self) -> None:
        self.ledger.elements -= self._elements


class Outline(TensorStandIn):
    """A tensor of `shape` that has no elements; it counts in `ledger` as long as it or a view of it exists.

    It is a view of `memory`, or has its own. Unless it `is_ordered`, reshaping copies its elements.
    """

    def __init__(
        self, shape: Shape, ledger: Ledger, memory: _Allocation | None = None, *, is_ordered: bool = True
    ) -> None:
        self.shape = shape
        self._memory = memory or _Allocation(ledger, math.prod(shape))
        self._is_ordered = is_ordered

    @property
    def ledger(self) -> Ledger:
        return self._memory.ledger

    def dim(self) -> int:
        return len(self.shape)

    def made(self, *shape: int) -> Outline:
        """Another outline, with elements of its own."""
        return Outline(shape, self.ledger)

    def __add__(self, other: Outline) -> Outline:
        if self.shape != other.shape:
            raise ValueError(f"features of the sizes {self.shape} and {other.shape} cannot be added")
        return self.made(*self.shape)

    def __getitem__(self, place: tuple[Any, ...]) -> Outline:
        """A view of rows or columns: an ellipsis and a slice of each of the last dimensions."""
        _, *slices = place
        first = len(self.shape) - len(slices)
        kept = [
            len(range(*part.indices(side))) for part, side in zip(slices, self.shape[first:], strict=True)
        ]
        return self._view((*self.shape[:first], *kept), is_ordered=False)

    def permute(self, *order: int) -> Outline:
        return self._view(tuple(self.shape[dim] for dim in order), is_ordered=False)

    def reshape(self, *sizes: Any) -> Outline:
        shape = tuple(sizes[0]) if isinstance(sizes[0], tuple) else sizes
        known = math.prod(size for size in shape if size != -1)
        shape = tuple(math.prod(self.shape) // known if size == -1 else size for size in shape)
        return self._view(shape, is_ordered=True) if self._is_ordered else self.made(*shape)

    view = reshape

    def flatten(self, start: int, end: int = -1) -> Outline:
        last = end % len(self.shape) + 1
        return self.reshape(*self.shape[:start], -1, *self.shape[last:])

    def _view(self, shape: Shape, *, is_ordered: bool) -> Outline:
        return Outline(shape, self.ledger, self._memory, is_ordered=is_ordered)


def _convolved(
    features: Outline,
    weight: torch.Tensor,
    bias: object,
    stride: Shape,
    padding: Shape,
    dilation: Shape,
    groups: int,
) -> Outline:
    made = features.made(
        features.shape[0],
        weight.shape[0],
        *_slid(features.shape[2:], tuple(weight.shape[2:]), stride, padding, dilation),
    )
    features.made(*weight.shape)  # torch sorts the weights for the processor in every run
    features.ledger.multiply_adds += math.prod(made.shape) * math.prod(weight.shape[1:])
    return made


def _transposed(
    features: Outline,
    weight: torch.Tensor,
    bias: object,
    stride: Shape,
    padding: Shape,
    output_padding: Shape,
    groups: int,
    dilation: Shape,
) -> Outline:
    sides = zip(features.shape[2:], stride, padding, dilation, weight.shape[2:], output_padding, strict=True)
    features.ledger.multiply_adds += math.prod(features.shape) * math.prod(weight.shape[1:])
    return features.made(
        features.shape[0],
        groups * weight.shape[1],
        *(
            (side - 1) * by - 2 * pad + far * (kernel - 1) + more + 1
            for side, by, pad, far, kernel, more in sides
        ),
    )


def _pooled(
    features: Outline, kernel: int, stride: int, padding: int = 0, dilation: int = 1, **_: object
) -> Outline:
    squares = ((side, side) for side in (kernel, stride, padding, dilation))
    pooled = features.made(*features.shape[:2], *_slid(features.shape[2:], *squares))
    pooled.made(2, *pooled.shape)  # torch also writes where each maximum is, in 64 bits, and drops that
    return pooled


def _slid(sides: Shape, kernel: Shape, stride: Shape, padding: Shape, dilation: Shape) -> list[int]:
    return [
        (side + 2 * pad - far * (window - 1) - 1) // step + 1
        for side, window, step, pad, far in zip(sides, kernel, stride, padding, dilation, strict=True)
    ]


def _resized(features: Outline, *, scale_factor: float, **_: object) -> Outline:
    return features.made(*features.shape[:2], *(int(side * scale_factor) for side in features.shape[2:]))


def _padded(features: Outline, pad: Shape, *_: object, **__: object) -> Outline:
    left, right, top, bottom = pad
    *outer, ny, nx = features.shape
    return features.made(*outer, ny + top + bottom, nx + left + right)


def _joined(features: Sequence[Outline], dim: int) -> Outline:
    shape = list(features[0].shape)
    shape[dim] = sum(part.shape[dim] for part in features)
    return features[0].made(*shape)


def _stacked(features: Sequence[Outline], dim: int) -> Outline:
    shape = list(features[0].shape)
    return features[0].made(*shape[:dim], len(features), *shape[dim:])


def _shuffled(features: Outline, factor: int) -> Outline:
    batch, channels, ny, nx = features.shape
    return features.made(batch, channels // factor**2, ny * factor, nx * factor)


def _in_place(features: Outline, *_: object, **__: object) -> Outline:
    """Activations work in place, and every runtime folds a normalisation into the convolution before it."""
    return features


def _linear(features: Outline, weight: torch.Tensor, bias: object = None) -> Outline:
    made = features.made(*features.shape[:-1], weight.shape[0])
    features.ledger.multiply_adds += math.prod(made.shape) * weight.shape[1]
    return made


def _attended(
    query: Outline, key: Outline, value: Outline, channels: int, heads: int, *_: object, **__: object
) -> tuple[Outline, None]:
    """Attention of every cell to every cell, as written in ONNX; torch does not keep all pairs at once."""
    cells, batch, _channels = query.shape
    projected = [query.made(*query.shape) for _part in range(3)]
    shares = [query.made(batch, heads, cells, cells) for _step in ("products", "softmax")]
    mixed = query.made(*query.shape)
    query.ledger.multiply_adds += cells * batch * channels * (4 * channels + 2 * cells)
    del projected, shares
    return mixed.made(*mixed.shape), None


Outline.functions = {
    torch.conv2d: _convolved,
    torch.conv_transpose2d: _transposed,
    torch.max_pool2d: _pooled,
    functional.max_pool2d: _pooled,
    functional.interpolate: _resized,
    functional.pad: _padded,
    torch.cat: _joined,
    torch.stack: _stacked,
    torch.pixel_shuffle: _shuffled,
    functional.batch_norm: _in_place,
    functional.silu: _in_place,
    functional.hardswish: _in_place,
    functional.leaky_relu: _in_place,
    functional.relu: _in_place,
    functional.linear: _linear,
    functional.multi_head_attention_forward: _attended,
}
