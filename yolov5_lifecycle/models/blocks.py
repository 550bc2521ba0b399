"""Blocks of several convolutions, pooling and attention, and layers without weights."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping
from types import MappingProxyType

import torch
from torch import Tensor, nn
from torch.nn import functional

from yolov5_lifecycle.models.convolutions import (
    Block,
    Conv,
    DWConv,
    fold_normalisation,
    layer_kind,
    normalisation,
)

_HEADS = 4
"""Of attention."""


class Shortcut(Block):
    """Two convolutions, added to their input if `add`."""

    cv1: Conv
    cv2: Conv
    add: bool

    def forward(self, features: Tensor) -> Tensor:
        refined: Tensor = self.cv2(self.cv1(features))
        return features + refined if self.add else refined


@layer_kind
class Bottleneck(Shortcut):
    def __init__(
        self,
        channels_in: int,
        channels_out: int,
        shortcut: bool = True,
        groups: int = 1,
        expansion: float = 0.5,
    ) -> None:
        super().__init__()
        hidden = int(channels_out * expansion)
        self.cv1 = Conv(channels_in, hidden, 1)
        self.cv2 = Conv(hidden, channels_out, 3, groups=groups)
        self.add = bool(shortcut) and channels_in == channels_out


@layer_kind
class CrossConv(Shortcut):
    """A convolution along the rows, then one along the columns."""

    def __init__(
        self,
        channels_in: int,
        channels_out: int,
        kernel: int = 3,
        stride: int = 1,
        groups: int = 1,
        expansion: float = 1.0,
        shortcut: bool = False,
    ) -> None:
        super().__init__()
        hidden = int(channels_out * expansion)
        self.cv1 = Conv(channels_in, hidden, (1, kernel), (1, stride))
        self.cv2 = Conv(hidden, channels_out, (kernel, 1), (stride, 1), groups=groups)
        self.add = bool(shortcut) and channels_in == channels_out


@layer_kind
class GhostConv(Block):
    """Half of the channels by a convolution, the other half by a depthwise one of the first."""

    def __init__(
        self,
        channels_in: int,
        channels_out: int,
        kernel: int = 1,
        stride: int = 1,
        groups: int = 1,
        *,
        is_activated: bool = True,
    ) -> None:
        super().__init__()
        if channels_out % 2:
            raise ValueError(f"a GhostConv has an even number of channels, not {channels_out}")
        half = channels_out // 2
        self.cv1 = Conv(channels_in, half, kernel, stride, groups=groups, is_activated=is_activated)
        self.cv2 = Conv(half, half, 5, groups=half, is_activated=is_activated)

    def forward(self, features: Tensor) -> Tensor:
        primary = self.cv1(features)
        return torch.cat((primary, self.cv2(primary)), dim=1)


@layer_kind
class GhostBottleneck(Block):
    """Two ghost convolutions, added to their input; at stride 2 both ways have a depthwise convolution."""

    def __init__(self, channels_in: int, channels_out: int, kernel: int = 3, stride: int = 1) -> None:
        super().__init__()
        if stride != 2 and channels_in != channels_out:
            raise ValueError(f"a GhostBottleneck cannot add {channels_in} to {channels_out} channels")
        half = channels_out // 2
        middle: nn.Module = nn.Identity()
        self.shortcut: nn.Module = nn.Identity()
        if stride == 2:
            middle = DWConv(half, half, kernel, stride, is_activated=False)
            self.shortcut = nn.Sequential(
                DWConv(channels_in, channels_in, kernel, stride, is_activated=False),
                Conv(channels_in, channels_out, is_activated=False),
            )
        self.conv = nn.Sequential(
            GhostConv(channels_in, half), middle, GhostConv(half, channels_out, is_activated=False)
        )

    def forward(self, features: Tensor) -> Tensor:
        added: Tensor = self.conv(features) + self.shortcut(features)
        return added


@layer_kind
class SPP(Block):
    """A max-pool of every window size, which ascend.

    Each is computed from the one before, with a small window: the result is the same to the bit.
    """

    def __init__(self, channels_in: int, channels_out: int, kernels: tuple[int, ...] = (5, 9, 13)) -> None:
        super().__init__()
        hidden = channels_in // 2
        self.cv1 = Conv(channels_in, hidden)
        self.cv2 = Conv((1 + len(kernels)) * hidden, channels_out)
        self.m: nn.Module = nn.ModuleList(
            nn.MaxPool2d(kernel, stride=1, padding=kernel // 2) for kernel in kernels
        )
        self.steps = tuple(wide - narrow + 1 for narrow, wide in itertools.pairwise((1, *kernels)))

    def forward(self, features: Tensor) -> Tensor:
        windows = [self.cv1(features)]
        for step in self.steps:
            windows.append(functional.max_pool2d(windows[-1], step, stride=1, padding=step // 2))
        merged: Tensor = self.cv2(torch.cat(windows, dim=1))
        return merged


@layer_kind
class SPPF(SPP):
    """Three max-pools of `kernel` one after the other, which cover three window sizes."""

    def __init__(self, channels_in: int, channels_out: int, kernel: int = 5) -> None:
        super().__init__(channels_in, channels_out, (kernel, 2 * kernel - 1, 3 * kernel - 2))
        self.m = nn.MaxPool2d(kernel, stride=1, padding=kernel // 2)


@layer_kind
class C3(Block):
    """Two convolutions of the input, of which `m` refines one, joined by a third; `m` are bottlenecks."""

    has_repeats_inside = True

    def __init__(
        self,
        channels_in: int,
        channels_out: int,
        repeats: int,
        shortcut: bool = True,
        groups: int = 1,
        expansion: float = 0.5,
    ) -> None:
        super().__init__()
        hidden = int(channels_out * expansion)
        self.cv1 = Conv(channels_in, hidden)
        self._add_junction(channels_in, hidden, channels_out)
        self.m = self._refinement(hidden, repeats, shortcut, groups)

    def _add_junction(self, channels_in: int, hidden: int, channels_out: int) -> None:
        """Add what the other way and the join consist of."""
        self.cv2: nn.Module = Conv(channels_in, hidden)
        self.cv3: nn.Module = Conv(2 * hidden, channels_out)

    def _refinement(self, hidden: int, repeats: int, shortcut: bool, groups: int) -> nn.Module:
        return nn.Sequential(*(self._part(hidden, shortcut, groups) for _ in range(repeats)))

    def _part(self, hidden: int, shortcut: bool, groups: int) -> nn.Module:
        return Bottleneck(hidden, hidden, shortcut, groups, 1.0)

    def forward(self, features: Tensor) -> Tensor:
        merged: Tensor = self.cv3(torch.cat((self.m(self.cv1(features)), self.cv2(features)), dim=1))
        return merged


@layer_kind
class C3x(C3):
    def _part(self, hidden: int, shortcut: bool, groups: int) -> nn.Module:
        return CrossConv(hidden, hidden, 3, 1, groups, 1.0, shortcut)


@layer_kind
class C3Ghost(C3):
    """Its parts always add their input, regardless of the argument `shortcut`."""

    def _part(self, hidden: int, shortcut: bool, groups: int) -> nn.Module:
        return GhostBottleneck(hidden, hidden)


@layer_kind
class C3SPP(C3):
    has_repeats_inside = False

    def __init__(self, channels_in: int, channels_out: int, kernels: tuple[int, ...] = (5, 9, 13)) -> None:
        self._kernels = kernels
        super().__init__(channels_in, channels_out, 1)

    def _refinement(self, hidden: int, repeats: int, shortcut: bool, groups: int) -> nn.Module:
        return SPP(hidden, hidden, self._kernels)


@layer_kind
class BottleneckCSP(C3):
    """As before v4: plain convolutions on both ways, normalised and activated where they join."""

    def _add_junction(self, channels_in: int, hidden: int, channels_out: int) -> None:
        self.cv2 = nn.Conv2d(channels_in, hidden, 1, bias=False)
        self.cv3 = nn.Conv2d(hidden, hidden, 1, bias=False)
        self.cv4 = Conv(2 * hidden, channels_out)
        self.bn: nn.Module = normalisation(2 * hidden)
        self.act: nn.Module = nn.SiLU(inplace=True)

    def forward(self, features: Tensor) -> Tensor:
        refined = self.cv3(self.m(self.cv1(features)))
        joined = torch.cat((refined, self.cv2(features)), dim=1)
        merged: Tensor = self.cv4(self.act(self.bn(joined)))
        return merged

    def fold(self) -> None:
        """Move the batch normalisation into the two convolutions."""
        fold_normalisation(self, self.cv3, self.cv2)


class TransformerLayer(nn.Module):
    def __init__(self, channels: int) -> None:
        super().__init__()
        if channels % _HEADS:
            raise ValueError(f"{channels} channels cannot be divided among {_HEADS} attention heads")
        self.q = nn.Linear(channels, channels, bias=False)
        self.k = nn.Linear(channels, channels, bias=False)
        self.v = nn.Linear(channels, channels, bias=False)
        self.ma = nn.MultiheadAttention(channels, _HEADS)
        self.fc1 = nn.Linear(channels, channels, bias=False)
        self.fc2 = nn.Linear(channels, channels, bias=False)

    def forward(self, cells: Tensor) -> Tensor:
        """Cells (ny * nx, B, C) -> the same shape."""
        attended, _ = self.ma(self.q(cells), self.k(cells), self.v(cells), need_weights=False)
        attended = attended + cells
        refined: Tensor = self.fc2(self.fc1(attended)) + attended
        return refined


class TransformerBlock(nn.Module):
    def __init__(self, channels: int, layers: int) -> None:
        super().__init__()
        self.linear = nn.Linear(channels, channels)
        self.tr = nn.Sequential(*(TransformerLayer(channels) for _ in range(layers)))

    def forward(self, features: Tensor) -> Tensor:
        cells = features.flatten(2).permute(2, 0, 1)  # (ny * nx, B, C)
        cells = self.tr(cells + self.linear(cells))
        refined: Tensor = cells.permute(1, 2, 0).reshape(features.shape)
        return refined


@layer_kind
class C3TR(C3):
    """Its repeats are those of the transformer's layers; it has neither shortcut nor groups."""

    def _refinement(self, hidden: int, repeats: int, shortcut: bool, groups: int) -> nn.Module:
        return TransformerBlock(hidden, repeats)


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


RESIZING: Mapping[str, Callable[..., nn.Module]] = MappingProxyType(
    {
        "Upsample": lambda: nn.Upsample(scale_factor=2, mode="nearest"),
        "MaxPool2d": nn.MaxPool2d,
        "ZeroPad2d": nn.ZeroPad2d,
        "Contract": Contract,
        "Expand": Expand,
    }
)
"""Makes a layer without weights, which changes the size of a feature map, from its arguments; by kind."""


def channels_after(module: nn.Module, channels: int) -> int:
    """Output channels of the layer with `channels` input channels; raises ValueError if impossible."""
    if isinstance(module, Contract):
        return channels * module.gain**2
    if isinstance(module, Expand):
        if channels % module.gain**2:
            raise ValueError(f"{channels} channels cannot become squares of {module.gain} x {module.gain}")
        return channels // module.gain**2
    return channels
