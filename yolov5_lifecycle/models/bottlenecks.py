"""Blocks of a few sequential convolutions, most of them with a shortcut."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from yolov5_lifecycle.models.blocks import Block, layer_kind
from yolov5_lifecycle.models.convolutions import Conv, DWConv, convolved


class Shortcut(Block):
    """Two convolutions, added to their input if `add`."""

    cv1: Conv
    cv2: Conv
    add: bool

    def forward(self, features: Tensor) -> Tensor:
        refined: Tensor = self.cv2(self.cv1(features))
        return features + refined if self.add else refined


@layer_kind()
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


@layer_kind(lambda cells, kernel=3, stride=1, *_: convolved(cells, kernel, stride))
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


@layer_kind(convolved)
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


@layer_kind(lambda cells, kernel=3, stride=1: convolved(cells, kernel, stride) if stride == 2 else cells)
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
