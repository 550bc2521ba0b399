"""The last layer of a network: detection, and for segmentation coefficients and prototypes of masks."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from yolov5_lifecycle.models.architecture import Architecture
from yolov5_lifecycle.models.convolutions import Block, Conv


class Detect(nn.Module):
    """Detection head: one 1x1 convolution per level and the decoding of their outputs."""

    anchors: Tensor  # (levels, anchors, 2) width, height in grid cells

    def __init__(self, architecture: Architecture, channels_in: list[int]) -> None:
        super().__init__()
        self.strides = architecture.strides
        self.coefficients = architecture.mask_coefficients
        self.outputs = 5 + architecture.classes + self.coefficients
        self.anchors_per_cell = len(architecture.anchors_px[0])
        # Python floats: arithmetic on the meta device would import torch._dynamo, which takes seconds.
        anchors = [
            [(width / stride, height / stride) for width, height in level]
            for level, stride in zip(architecture.anchors_px, architecture.strides, strict=True)
        ]
        self.register_buffer("anchors", torch.tensor(anchors, dtype=torch.float32))
        self.m = nn.ModuleList(
            nn.Conv2d(channels, self.outputs * self.anchors_per_cell, 1) for channels in channels_in
        )

    def forward(self, features: list[Tensor]) -> list[Tensor]:
        """Raw logits of each level, (B, anchors, ny, nx, 5 + C + M)."""
        logits = []
        for convolution, level in zip(self.m, features, strict=True):
            batch, _, ny, nx = level.shape
            grid = convolution(level).view(batch, self.anchors_per_cell, self.outputs, ny, nx)
            logits.append(grid.permute(0, 1, 3, 4, 2))
        return logits

    def decode(self, logits: list[Tensor]) -> Tensor:
        """Logits of all levels -> (B, N, 5 + C + M): cx, cy, w, h in network pixels, then probabilities.

        xy = (2 sigma - 0.5 + cell) * stride and wh = (2 sigma)^2 * anchor, with sigma the logistic function.
        The M coefficients of masks, last, stay as they are.
        """
        rows = []
        for level, stride, anchors in zip(logits, self.strides, self.anchors, strict=True):
            batch, _, ny, nx, outputs = level.shape
            bounded, coefficients = level.split((outputs - self.coefficients, self.coefficients), dim=-1)
            xy, wh, scores = bounded.sigmoid().split((2, 2, bounded.shape[-1] - 4), dim=-1)
            xy = (2 * xy - 0.5 + _cells(ny, nx, like=level)) * stride
            wh = (2 * wh) ** 2 * (anchors * stride).view(1, -1, 1, 1, 2)
            rows.append(torch.cat((xy, wh, scores, coefficients), dim=-1).reshape(batch, -1, outputs))
        return torch.cat(rows, dim=1)


def _cells(ny: int, nx: int, *, like: Tensor) -> Tensor:
    """Column and row index of every grid cell, (ny, nx, 2)."""
    rows = torch.arange(ny, device=like.device, dtype=like.dtype)
    columns = torch.arange(nx, device=like.device, dtype=like.dtype)
    grid_y, grid_x = torch.meshgrid(rows, columns, indexing="ij")
    return torch.stack((grid_x, grid_y), dim=-1)


class Proto(Block):
    """Features of the finest level, (B, channels, ny, nx) -> prototypes of masks, (B, M, 2 ny, 2 nx)."""

    def __init__(self, channels_in: int, hidden: int, prototypes: int) -> None:
        super().__init__()
        self.cv1 = Conv(channels_in, hidden, 3)
        self.upsample = nn.Upsample(scale_factor=2, mode="nearest")
        self.cv2 = Conv(hidden, hidden, 3)
        self.cv3 = Conv(hidden, prototypes)
        self.quarters: nn.ModuleList | None = None

    def forward(self, features: Tensor) -> Tensor:
        widened = self.cv1(features)
        if self.quarters is None:
            prototypes: Tensor = self.cv3(self.cv2(self.upsample(widened)))
            return prototypes
        ny, nx = widened.shape[2:]
        padded = functional.pad(widened, (1, 1, 1, 1))
        quarters = [
            self.cv3(self.cv2.act(convolution(padded[..., row : row + ny + 1, column : column + nx + 1])))
            for convolution, (row, column) in zip(self.quarters, PARITIES, strict=True)
        ]
        return functional.pixel_shuffle(torch.stack(quarters, dim=2).flatten(1, 2), 2)

    def fold(self) -> None:
        """Convolve before the upsampling, which repeats each cell in a square of four.

        Each quarter of the output needs 2x2 cells instead of 3x3, so less than half the arithmetic.
        """
        if self.quarters is not None:
            return
        self.cv2.fold()
        convolution = self.cv2.conv
        assert convolution.bias is not None
        self.quarters = nn.ModuleList(
            _quarter(_summed(_summed(convolution.weight.detach(), 2, row), 3, column), convolution.bias)
            for row, column in PARITIES
        )


PARITIES = ((0, 0), (0, 1), (1, 0), (1, 1))
"""Row and column of an upsampled cell within its square."""


def _summed(weight: Tensor, dim: int, parity: int) -> Tensor:
    """The three weights along `dim` as two: those that meet the same cell before the upsampling are added."""
    first, middle, last = weight.unbind(dim)
    return torch.stack((first + middle, last) if parity else (first, middle + last), dim)


def _quarter(weight: Tensor, bias: Tensor) -> nn.Conv2d:
    channels_out, channels_in, *_ = weight.shape
    with torch.device("meta"):
        convolution = nn.Conv2d(channels_in, channels_out, 2)
    convolution.weight, convolution.bias = nn.Parameter(weight), nn.Parameter(bias.detach())
    return convolution


class Segment(Detect):
    """`Detect` whose predictions also have the coefficients with which a mask combines the prototypes."""

    def __init__(self, architecture: Architecture, channels_in: list[int]) -> None:
        super().__init__(architecture, channels_in)
        self.proto = Proto(channels_in[0], architecture.prototype_channels, self.coefficients)


HEADS: dict[str, type[Detect]] = {"Detect": Detect, "Segment": Segment}
"""The kinds of last layers."""
