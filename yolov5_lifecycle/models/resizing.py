"""Layers without weights, which change the size of a feature map."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import NamedTuple

from torch import Tensor, nn

from yolov5_lifecycle.models.cells import Cells


class Contract(nn.Module):
    """Squares of `gain` x `gain` cells become channels, row by row."""

    def __init__(self, gain: int) -> None:
        super().__init__()
        self.gain = gain

    def forward(self, features: Tensor) -> Tensor:
        batch, channels, ny, nx = features.shape
        gain = self.gain
        squares = features.reshape(batch, channels, ny // gain, gain, nx // gain, gain)
        return squares.permute(0, 3, 5, 1, 2, 4).reshape(batch, -1, ny // gain, nx // gain)


class Expand(nn.Module):
    """Channels become squares of `gain` x `gain` cells: the inverse of `Contract`."""

    def __init__(self, gain: int) -> None:
        super().__init__()
        self.gain = gain

    def forward(self, features: Tensor) -> Tensor:
        batch, channels, ny, nx = features.shape
        gain = self.gain
        squares = features.reshape(batch, gain, gain, channels // gain**2, ny, nx)
        return squares.permute(0, 3, 4, 1, 5, 2).reshape(batch, -1, ny * gain, nx * gain)


class Resizing(NamedTuple):
    """Creates a layer from its arguments; `cells_after` maps input cells and arguments to output cells."""

    make: Callable[..., nn.Module]
    cells_after: Callable[..., Cells]


RESIZING: Mapping[str, Resizing] = MappingProxyType(
    {
        "Upsample": Resizing(
            lambda: nn.Upsample(scale_factor=2, mode="nearest"), lambda cells: cells.expanded(2)
        ),
        "MaxPool2d": Resizing(nn.MaxPool2d, Cells.slid),
        "ZeroPad2d": Resizing(nn.ZeroPad2d, lambda cells, sides: cells.padded(sides[0] + sides[1])),
        "Contract": Resizing(Contract, Cells.contracted),
        "Expand": Resizing(Expand, Cells.expanded),
    }
)
"""By kind of layer."""


def channels_after(module: nn.Module, channels: int) -> int:
    """Output channels of the layer with `channels` input channels; raises ValueError if impossible."""
    if isinstance(module, Contract):
        return channels * module.gain**2
    if isinstance(module, Expand):
        if channels % module.gain**2:
            raise ValueError(f"{channels} channels cannot become squares of {module.gain} x {module.gain}")
        return channels // module.gain**2
    return channels
