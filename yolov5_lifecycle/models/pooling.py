"""Spatial pyramid pooling: max-pools with several window sizes side by side."""

from __future__ import annotations

import itertools

import torch
from torch import Tensor, nn
from torch.nn import functional

from yolov5_lifecycle.models.blocks import Block, layer_kind
from yolov5_lifecycle.models.convolutions import Conv


@layer_kind()
class SPPF(Block):
    """Three sequential max-pools cover three window sizes."""

    def __init__(self, channels_in: int, channels_out: int, kernel: int = 5) -> None:
        super().__init__()
        hidden = channels_in // 2
        self.cv1 = Conv(channels_in, hidden)
        self.cv2 = Conv(4 * hidden, channels_out)
        self.m = nn.MaxPool2d(kernel, stride=1, padding=kernel // 2)

    def forward(self, features: Tensor) -> Tensor:
        windows = [self.cv1(features)]
        for _ in range(3):
            windows.append(self.m(windows[-1]))
        merged: Tensor = self.cv2(torch.cat(windows, dim=1))
        return merged


@layer_kind()
class SPP(Block):
    """A max-pool of every window size, which ascend.

    Each is computed from the one before, with a small window: the result is the same to the bit.
    """

    def __init__(self, channels_in: int, channels_out: int, kernels: tuple[int, ...] = (5, 9, 13)) -> None:
        super().__init__()
        hidden = channels_in // 2
        self.cv1 = Conv(channels_in, hidden)
        self.cv2 = Conv((1 + len(kernels)) * hidden, channels_out)
        self.m = nn.ModuleList(nn.MaxPool2d(kernel, stride=1, padding=kernel // 2) for kernel in kernels)
        self.steps = tuple(wide - narrow + 1 for narrow, wide in itertools.pairwise((1, *kernels)))

    def forward(self, features: Tensor) -> Tensor:
        windows = [self.cv1(features)]
        for step in self.steps:
            windows.append(functional.max_pool2d(windows[-1], step, stride=1, padding=step // 2))
        merged: Tensor = self.cv2(torch.cat(windows, dim=1))
        return merged
