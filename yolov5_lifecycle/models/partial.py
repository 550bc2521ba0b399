"""Cross-stage partial blocks: some channels are refined, the others bypass the refinement."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from yolov5_lifecycle.models.blocks import Block, layer_kind
from yolov5_lifecycle.models.bottlenecks import Bottleneck, CrossConv, GhostBottleneck
from yolov5_lifecycle.models.convolutions import Conv, normalisation, normalised
from yolov5_lifecycle.models.pooling import SPP


class _TwoWays(Block):
    """One convolution of the input is refined by `m`; a subclass joins that with another one."""

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
        raise NotImplementedError

    def _refinement(self, hidden: int, repeats: int, shortcut: bool, groups: int) -> nn.Module:
        return nn.Sequential(*(self._part(hidden, shortcut, groups) for _ in range(repeats)))

    def _part(self, hidden: int, shortcut: bool, groups: int) -> nn.Module:
        return Bottleneck(hidden, hidden, shortcut, groups, 1.0)


class Partial(_TwoWays):
    """A convolution on the other way, one after the join."""

    def _add_junction(self, channels_in: int, hidden: int, channels_out: int) -> None:
        self.cv2 = Conv(channels_in, hidden)
        self.cv3 = Conv(2 * hidden, channels_out)

    def forward(self, features: Tensor) -> Tensor:
        merged: Tensor = self.cv3(torch.cat((self.m(self.cv1(features)), self.cv2(features)), dim=1))
        return merged


@layer_kind()
class C3(Partial):
    """Its parts are bottlenecks."""


@layer_kind()
class C3x(Partial):
    def _part(self, hidden: int, shortcut: bool, groups: int) -> nn.Module:
        return CrossConv(hidden, hidden, 3, 1, groups, 1.0, shortcut)


@layer_kind()
class C3Ghost(Partial):
    """Its parts always add their input, regardless of the argument `shortcut`."""

    def _part(self, hidden: int, shortcut: bool, groups: int) -> nn.Module:
        return GhostBottleneck(hidden, hidden)


@layer_kind()
class C3SPP(Partial):
    has_repeats_inside = False

    def __init__(self, channels_in: int, channels_out: int, kernels: tuple[int, ...] = (5, 9, 13)) -> None:
        self._kernels = kernels
        super().__init__(channels_in, channels_out, 1)

    def _refinement(self, hidden: int, repeats: int, shortcut: bool, groups: int) -> nn.Module:
        return SPP(hidden, hidden, self._kernels)


class NormalisedPartial(_TwoWays):
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
        if isinstance(self.bn, nn.BatchNorm2d):
            self.cv3, self.cv2 = normalised([self.cv3, self.cv2], self.bn)
            self.bn = nn.Identity()


@layer_kind()
class BottleneckCSP(NormalisedPartial):
    """Its parts are bottlenecks."""


@layer_kind()
class CrossCSP(NormalisedPartial):
    """The block named C3 in the experimental module of v3.0 and v3.1."""

    def _part(self, hidden: int, shortcut: bool, groups: int) -> nn.Module:
        return CrossConv(hidden, hidden, 3, 1, groups, 1.0, shortcut)
