"""Convolutions with normalisation and activation, other single convolutions, and what all blocks share.

The blocks have the names and state-dict keys of checkpoints. Their constructors take the numbers
of input and output channels, with `has_repeats_inside` the number of repeats, and then the arguments of the
layer.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from math import gcd
from types import MappingProxyType
from typing import ClassVar, TypeVar

import torch
from torch import Tensor, nn

EPSILON = 1e-3
"""That of every batch normalisation; no state dict holds it."""
LAYER_KINDS: dict[str, type[nn.Module]] = {}
"""The kinds of layers that have output channels of their own, by the names of their classes."""
ACTIVATIONS: Mapping[str, Callable[..., nn.Module]] = MappingProxyType(
    {
        "SiLU": nn.SiLU,
        "Hardswish": nn.Hardswish,
        "LeakyReLU": nn.LeakyReLU,
        "ReLU": nn.ReLU,
        "Identity": nn.Identity,
    }
)
"""By class name in torch; a LeakyReLU has its negative slope in parentheses, as in "LeakyReLU(0.1)"."""
_LEAKY = re.compile(r"LeakyReLU\((0(?:\.\d{1,12})?|1(?:\.0)?)\)")


_Registered = TypeVar("_Registered", bound=type[nn.Module])


def layer_kind(block: _Registered) -> _Registered:
    """Register a class as the kind of layer of its name."""
    LAYER_KINDS[block.__name__] = block
    return block


class Block(nn.Module):
    """A part of a network that can be made faster once its weights no longer change."""

    has_repeats_inside: ClassVar[bool] = False
    """Whether the repeats of a layer are an argument; otherwise the block itself is repeated."""

    def fold(self) -> None:
        """Merge what can be merged for inference, in place; up to rounding the output stays the same."""


@layer_kind
class Conv(Block):
    """Convolution, batch normalisation, activation; `padding` keeps the size at stride 1.

    The default of `padding` is (kernel - 1) // 2, also for the 6x6 kernel of the first layer of v6.
    """

    def __init__(
        self,
        channels_in: int,
        channels_out: int,
        kernel: int | tuple[int, int] = 1,
        stride: int | tuple[int, int] = 1,
        padding: int | None = None,
        groups: int = 1,
        dilation: int = 1,
        *,
        is_activated: bool = True,
    ) -> None:
        super().__init__()
        if min(channels_in, channels_out) < 1:
            raise ValueError("a convolution without channels")
        self.conv = nn.Conv2d(
            channels_in,
            channels_out,
            kernel,
            stride,
            _padding(kernel, dilation) if padding is None else padding,
            dilation,
            groups,
            bias=False,
        )
        self.bn: nn.Module = normalisation(channels_out)
        self.act: nn.Module = nn.SiLU(inplace=True) if is_activated else nn.Identity()

    def forward(self, features: Tensor) -> Tensor:
        activated: Tensor = self.act(self.bn(self.conv(features)))
        return activated

    def fold(self) -> None:
        """Move the batch normalisation into the convolution."""
        fold_normalisation(self, self.conv)

    def drop_bn(self) -> None:
        """Replace the normalisation by a bias of the convolution, both without values."""
        if isinstance(self.bn, nn.BatchNorm2d):
            self.conv.bias = nn.Parameter(torch.zeros(self.conv.out_channels))
            self.bn = nn.Identity()


@layer_kind
class DWConv(Conv):
    """A convolution in as many groups as both numbers of channels allow."""

    def __init__(
        self,
        channels_in: int,
        channels_out: int,
        kernel: int = 1,
        stride: int = 1,
        dilation: int = 1,
        *,
        is_activated: bool = True,
    ) -> None:
        groups = gcd(channels_in, channels_out)
        super().__init__(
            channels_in, channels_out, kernel, stride, None, groups, dilation, is_activated=is_activated
        )


@layer_kind
class Focus(Block):
    """Four pixels become four times the channels, then a convolution: first layer of networks before v6."""

    def __init__(self, channels_in: int, channels_out: int, kernel: int = 1, stride: int = 1) -> None:
        super().__init__()
        self.conv = Conv(4 * channels_in, channels_out, kernel, stride)
        self._is_folded = False

    def forward(self, features: Tensor) -> Tensor:
        if not self._is_folded:
            rows = (features[..., 0::2, :], features[..., 1::2, :])
            quarters = [row[..., first::2] for first in (0, 1) for row in rows]
            features = torch.cat(quarters, dim=1)
        convolved: Tensor = self.conv(features)
        return convolved

    def fold(self) -> None:
        """Compute the same with one convolution of the pixels, of twice the kernel and stride."""
        if self._is_folded:
            return
        narrow = self.conv.conv
        kernel, stride, padding = (2 * side for side in _sides(narrow))
        with torch.device(narrow.weight.device):
            wide = nn.Conv2d(
                narrow.in_channels // 4, narrow.out_channels, kernel, stride, padding, bias=False
            )
        # (out, column parity, row parity, in, ky, kx) -> (out, in, ky, row parity, kx, column parity)
        quarters = narrow.weight.detach().view(-1, 2, 2, wide.in_channels, kernel // 2, kernel // 2)
        wide.weight = nn.Parameter(quarters.permute(0, 3, 4, 2, 5, 1).reshape(wide.weight.shape))
        wide.bias = narrow.bias
        self.conv.conv = wide.train(narrow.training)
        self._is_folded = True


@layer_kind
class MixConv2d(Block):
    """Convolutions with different kernels side by side, normalised and activated together."""

    def __init__(
        self, channels_in: int, channels_out: int, kernels: tuple[int, ...] = (1, 3), stride: int = 1
    ) -> None:
        super().__init__()
        # Channel i of n goes to the part in which the i-th of n equidistant points lies.
        if channels_out < len(kernels):
            raise ValueError("a convolution without channels")
        points = torch.linspace(0, len(kernels) - 1e-6, channels_out, device="cpu").floor().tolist()
        self.m = nn.ModuleList(
            nn.Conv2d(
                channels_in, part, kernel, stride, kernel // 2, groups=gcd(channels_in, part), bias=False
            )
            for kernel, part in zip(kernels, map(points.count, range(len(kernels))), strict=True)
        )
        self.bn: nn.Module = normalisation(channels_out)
        self.act: nn.Module = nn.SiLU(inplace=True)

    def forward(self, features: Tensor) -> Tensor:
        parts = torch.cat([convolution(features) for convolution in self.m], dim=1)
        activated: Tensor = self.act(self.bn(parts))
        return activated

    def fold(self) -> None:
        """Move the batch normalisation into the convolutions."""
        fold_normalisation(self, *self.m)


@layer_kind
class DWConvTranspose2d(nn.ConvTranspose2d):
    """A transposed convolution in as many groups as both numbers of channels allow."""

    def __init__(
        self,
        channels_in: int,
        channels_out: int,
        kernel: int = 1,
        stride: int = 1,
        padding: int = 0,
        output_padding: int = 0,
    ) -> None:
        groups = gcd(channels_in, channels_out)
        super().__init__(channels_in, channels_out, kernel, stride, padding, output_padding, groups)


@layer_kind
class ConvTranspose2d(nn.ConvTranspose2d):
    """torch's own, as a layer."""


def fold_normalisation(block: nn.Module, *convolutions: nn.Module) -> None:
    """Move the normalisation `block.bn` into `convolutions` without bias, whose outputs it reads in order."""
    bn = block.bn
    if not isinstance(bn, nn.BatchNorm2d):
        return
    assert isinstance(bn.running_var, Tensor)
    assert isinstance(bn.running_mean, Tensor)
    scale = bn.weight / (bn.running_var + bn.eps).sqrt()
    shift = bn.bias - bn.running_mean * scale
    first = 0
    for convolution in convolutions:
        assert isinstance(convolution, nn.Conv2d)
        part = slice(first, first + convolution.out_channels)
        convolution.weight = nn.Parameter(convolution.weight * scale[part].view(-1, 1, 1, 1))
        convolution.bias = nn.Parameter(shift[part].clone())
        first = part.stop
    block.bn = nn.Identity()


def normalisation(channels: int) -> nn.BatchNorm2d:
    return nn.BatchNorm2d(channels, eps=EPSILON, momentum=0.03)


def _padding(kernel: int | tuple[int, int], dilation: int) -> int | tuple[int, int]:
    if isinstance(kernel, int):
        return dilation * (kernel - 1) // 2
    high, wide = (dilation * (side - 1) // 2 for side in kernel)
    return high, wide


def _sides(convolution: nn.Conv2d) -> tuple[int, int, int]:
    """Kernel, stride and padding of a square convolution."""
    return convolution.kernel_size[0], convolution.stride[0], int(convolution.padding[0])


def activation_of(name: str) -> nn.Module:
    """The module of an activation such as "SiLU" or "LeakyReLU(0.1)"; raises ValueError for others."""
    if leaky := _LEAKY.fullmatch(name):
        return nn.LeakyReLU(float(leaky[1]), inplace=True)
    if name == "Identity":
        return nn.Identity()
    if name not in ACTIVATIONS or name == "LeakyReLU":
        raise ValueError(f"expected an activation, one of {', '.join(ACTIVATIONS)}, found {name[:40]!r}")
    return ACTIVATIONS[name](inplace=True)


def leaky_relu(negative_slope: float) -> str:
    """The name of a LeakyReLU, with at most 12 digits of its slope, which is in [0, 1]."""
    return f"LeakyReLU({f'{negative_slope:.12f}'.rstrip('0').rstrip('.')})"
