"""YOLOv5 v6/v7 as a torch module: pixels in, raw predictions out."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from yolov5_lifecycle.models.architecture import Architecture, Layer


class Conv(nn.Module):
    """Convolution, batch normalisation, SiLU; `padding` keeps the size at stride 1."""

    def __init__(self, channels_in: int, channels_out: int, kernel: int = 1, stride: int = 1) -> None:
        super().__init__()
        # The 6x6 stem of v6 pads by 2; everything else pads by half its odd kernel.
        padding = (kernel - 1) // 2
        self.conv = nn.Conv2d(channels_in, channels_out, kernel, stride, padding, bias=False)
        self.bn: nn.Module = nn.BatchNorm2d(channels_out, eps=1e-3, momentum=0.03)
        self.act = nn.SiLU(inplace=True)

    def forward(self, features: Tensor) -> Tensor:
        activated: Tensor = self.act(self.bn(self.conv(features)))
        return activated

    def fold_bn(self) -> None:
        """Move the batch normalisation into the convolution; the output stays the same."""
        if isinstance(self.bn, nn.BatchNorm2d):
            self.conv = nn.utils.fuse_conv_bn_eval(self.conv, self.bn)
            self.bn = nn.Identity()


class Bottleneck(nn.Module):
    def __init__(self, channels: int, shortcut: bool) -> None:
        super().__init__()
        self.cv1 = Conv(channels, channels, 1)
        self.cv2 = Conv(channels, channels, 3)
        self.shortcut = shortcut

    def forward(self, features: Tensor) -> Tensor:
        refined: Tensor = self.cv2(self.cv1(features))
        return features + refined if self.shortcut else refined


class C3(nn.Module):
    """Cross-stage partial block: bottlenecks on one half of the channels, the other half bypasses them."""

    def __init__(self, channels_in: int, channels_out: int, repeats: int, shortcut: bool) -> None:
        super().__init__()
        hidden = channels_out // 2
        self.cv1 = Conv(channels_in, hidden)
        self.cv2 = Conv(channels_in, hidden)
        self.cv3 = Conv(2 * hidden, channels_out)
        self.m = nn.Sequential(*(Bottleneck(hidden, shortcut) for _ in range(repeats)))

    def forward(self, features: Tensor) -> Tensor:
        merged: Tensor = self.cv3(torch.cat((self.m(self.cv1(features)), self.cv2(features)), dim=1))
        return merged


class SPPF(nn.Module):
    """Spatial pyramid pooling: three sequential max-pools cover three window sizes."""

    def __init__(self, channels_in: int, channels_out: int, kernel: int) -> None:
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


class Concat(nn.Module):
    def forward(self, features: list[Tensor]) -> Tensor:
        return torch.cat(features, dim=1)


class Detect(nn.Module):
    """Detection head: one 1x1 convolution per level and the decoding of their outputs."""

    anchors: Tensor  # (levels, anchors, 2) width, height in grid cells

    def __init__(self, architecture: Architecture, channels_in: list[int]) -> None:
        super().__init__()
        self.strides = architecture.strides
        self.outputs = architecture.classes + 5
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
        """Raw logits of each level, (B, anchors, ny, nx, 5 + C)."""
        logits = []
        for convolution, level in zip(self.m, features, strict=True):
            batch, _, ny, nx = level.shape
            grid = convolution(level).view(batch, self.anchors_per_cell, self.outputs, ny, nx)
            logits.append(grid.permute(0, 1, 3, 4, 2))
        return logits

    def decode(self, logits: list[Tensor]) -> Tensor:
        """Logits of all levels -> (B, N, 5 + C): cx, cy, w, h in network pixels, then probabilities.

        xy = (2 sigma - 0.5 + cell) * stride and wh = (2 sigma)^2 * anchor, with sigma the logistic function.
        """
        rows = []
        for level, stride, anchors in zip(logits, self.strides, self.anchors, strict=True):
            batch, _, ny, nx, outputs = level.shape
            xy, wh, scores = level.sigmoid().split((2, 2, outputs - 4), dim=-1)
            xy = (2 * xy - 0.5 + _cells(ny, nx, like=level)) * stride
            wh = (2 * wh) ** 2 * (anchors * stride).view(1, -1, 1, 1, 2)
            rows.append(torch.cat((xy, wh, scores), dim=-1).reshape(batch, -1, outputs))
        return torch.cat(rows, dim=1)


def _cells(ny: int, nx: int, *, like: Tensor) -> Tensor:
    """Column and row index of every grid cell, (ny, nx, 2)."""
    rows = torch.arange(ny, device=like.device, dtype=like.dtype)
    columns = torch.arange(nx, device=like.device, dtype=like.dtype)
    grid_y, grid_x = torch.meshgrid(rows, columns, indexing="ij")
    return torch.stack((grid_x, grid_y), dim=-1)


class Network(nn.Module):
    """Network of an architecture; state-dict keys and shapes match official checkpoints."""

    def __init__(self, architecture: Architecture) -> None:
        super().__init__()
        self.architecture = architecture
        self.model = nn.ModuleList(_modules(architecture))

    def heads(self, pixels: Tensor) -> list[Tensor]:
        """Logits of each detection level, (B, anchors, ny, nx, 5 + C), for training.

        `pixels`: (B, 3, H, W) float RGB in [0, 1], H and W multiples of the largest stride.
        """
        outputs: list[Tensor] = []
        last: Tensor | list[Tensor] = pixels
        for layer, module in zip(self.architecture.layers, self.model, strict=True):
            inputs = [last if source == -1 else outputs[source] for source in layer.sources]
            last = module(inputs if layer.kind in ("Concat", "Detect") else inputs[0])
            outputs.append(last)  # type: ignore[arg-type]  # only Detect returns a list, and it is the last
        return last  # type: ignore[return-value]

    def forward(self, pixels: Tensor) -> Tensor:
        """Predictions (B, N, 5 + C): cx, cy, w, h in network pixels, objectness, class scores in [0, 1].

        `pixels` as for `heads`. Decoded in float32 whatever the layers' dtype: fp16 resolves a box at x = 600
        only to half a pixel. Training mode returns the same format.
        """
        detect = self.model[-1]
        assert isinstance(detect, Detect)
        return detect.decode([level.float() for level in self.heads(pixels)])


def fuse(network: Network) -> Network:
    """Fold every batch normalisation of `network` (in evaluation mode) into its convolution, in place."""
    network.eval()
    for module in network.modules():
        if isinstance(module, Conv):
            module.fold_bn()
    return network.requires_grad_(False)


def _modules(architecture: Architecture) -> list[nn.Module]:
    modules: list[nn.Module] = []
    channels: list[int] = []
    for layer in architecture.layers:
        channels_in = [
            (channels or [3])[source] if source == -1 else channels[source] for source in layer.sources
        ]
        module, channels_out = _module(layer, channels_in, architecture)
        modules.append(module)
        channels.append(channels_out)
    return modules


def _module(layer: Layer, channels_in: list[int], architecture: Architecture) -> tuple[nn.Module, int]:
    """The module of one layer and its number of output channels."""
    if layer.kind == "Concat":
        return Concat(), sum(channels_in)
    if layer.kind == "Upsample":
        return nn.Upsample(scale_factor=2, mode="nearest"), channels_in[0]
    if layer.kind == "Detect":
        return Detect(architecture, channels_in), 0
    channels_out = math.ceil(layer.args[0] * architecture.width_multiple / 8) * 8
    if layer.kind == "Conv":
        return Conv(channels_in[0], channels_out, *layer.args[1:]), channels_out
    if layer.kind == "SPPF":
        return SPPF(channels_in[0], channels_out, layer.args[1]), channels_out
    repeats = layer.scaled_repeats(architecture.depth_multiple)
    shortcut = bool(layer.args[1]) if len(layer.args) > 1 else True
    return C3(channels_in[0], channels_out, repeats, shortcut), channels_out
