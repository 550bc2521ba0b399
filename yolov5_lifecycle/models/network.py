"""YOLOv5 as a torch module: pixels in, raw predictions out."""

from __future__ import annotations

import torch
from torch import Tensor, nn

# The modules of blocks register them as kinds of layers.
from yolov5_lifecycle.models import attention, bottlenecks, partial, pooling  # noqa: F401
from yolov5_lifecycle.models.activations import activation_of
from yolov5_lifecycle.models.architecture import Architecture, Layer
from yolov5_lifecycle.models.blocks import LAYER_KINDS, Block
from yolov5_lifecycle.models.convolutions import Conv
from yolov5_lifecycle.models.resizing import RESIZING, channels_after


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
        _set_activations(self, architecture)
        if architecture.is_fused:
            for module in self.modules():
                if isinstance(module, Conv):
                    module.drop_bn()

    def heads(self, pixels: Tensor) -> list[Tensor]:
        """Logits of each detection level, (B, anchors, ny, nx, 5 + C), for training.

        `pixels`: (B, 3, H, W) float RGB in [0, 1], H and W multiples of the largest stride; (B, 1, H, W) for
        networks of grey images.
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
    """Fold every normalisation of `network` (in evaluation mode) into its convolution, in place.

    Blocks that can be computed faster in another way are changed, too; see `Block.fold`.
    """
    network.eval()
    for module in list(network.modules()):
        if isinstance(module, Block):
            module.fold()
    return network.requires_grad_(False)


def _modules(architecture: Architecture) -> list[nn.Module]:
    modules: list[nn.Module] = []
    channels: list[int] = []
    for layer in architecture.layers:
        available = channels or [architecture.image_channels]
        channels_in = [available[source] for source in layer.sources]
        module, channels_out = _module(layer, channels_in, architecture)
        modules.append(module)
        channels.append(channels_out)
    return modules


def _module(layer: Layer, channels_in: list[int], architecture: Architecture) -> tuple[nn.Module, int]:
    """The module of one layer and its number of output channels."""
    if layer.kind == "Concat":
        return Concat(), sum(channels_in)
    if layer.kind == "Detect":
        return Detect(architecture, channels_in), 0
    if layer.kind in RESIZING:
        module = RESIZING[layer.kind].make(*layer.args)
        return module, channels_after(module, channels_in[0])
    unscaled, *arguments = layer.args
    assert isinstance(unscaled, int)
    channels_out = architecture.scaled_channels(unscaled)
    block = LAYER_KINDS[layer.kind].block
    repeats = layer.scaled_repeats(architecture.depth_multiple)
    if has_repeats_inside(layer.kind):
        return block(channels_in[0], channels_out, repeats, *arguments), channels_out
    if repeats == 1:
        return block(channels_in[0], channels_out, *arguments), channels_out
    if channels_in[0] != channels_out:
        raise ValueError(f"a {layer.kind} of {channels_in[0]} to {channels_out} channels cannot be repeated")
    return nn.Sequential(
        *(block(channels_out, channels_out, *arguments) for _ in range(repeats))
    ), channels_out


def has_repeats_inside(kind: str) -> bool:
    """Whether the repeats of a layer of this kind are an argument of its block."""
    block = LAYER_KINDS[kind].block if kind in LAYER_KINDS else nn.Module
    return issubclass(block, Block) and block.has_repeats_inside


def _set_activations(network: nn.Module, architecture: Architecture) -> None:
    """Give the activations of `architecture` to modules made with SiLU; others have none on purpose."""
    others = dict(architecture.other_activations)
    for path, module in list(network.named_modules()):
        if isinstance(act := getattr(module, "act", None), nn.Module):
            usual = architecture.activation if isinstance(act, nn.SiLU) else "Identity"
            module.act = activation_of(others.pop(f"{path}.act", usual))
    if others:
        raise ValueError(f"there is no activation at {next(iter(others))[:100]}")
