"""YOLOv5 as a torch module: pixels in, raw predictions out."""

from __future__ import annotations

from typing import TypeVar

import torch
from torch import Tensor, nn

from yolov5_lifecycle.models.architecture import Architecture, Layer
from yolov5_lifecycle.models.blocks import RESIZING, channels_after
from yolov5_lifecycle.models.convolutions import LAYER_KINDS, Block, Conv, activation_of
from yolov5_lifecycle.models.head import HEADS, Detect

Module = TypeVar("Module", bound=nn.Module)


class Concat(nn.Module):
    def forward(self, features: list[Tensor]) -> Tensor:
        return torch.cat(features, dim=1)


class Network(nn.Module):
    """Network of an architecture; state-dict keys and shapes match official checkpoints."""

    def __init__(self, architecture: Architecture) -> None:
        super().__init__()
        self.architecture = architecture
        self.model = nn.ModuleList(_modules(architecture))
        self._sources = _absolute_sources(architecture)
        self._last_read = _last_read(self._sources)
        _set_activations(self, architecture)
        if architecture.is_fused:
            for module in self.modules():
                if isinstance(module, Conv):
                    module.drop_bn()

    @property
    def head(self) -> Detect:
        """The last layer."""
        head = self.model[-1]
        assert isinstance(head, Detect)
        return head

    def features(self, pixels: Tensor) -> list[Tensor]:
        """What the head reads: a feature map (B, channels, ny, nx) for each level.

        `pixels`: (B, 3, H, W) float RGB in [0, 1], H and W multiples of the largest stride; (B, 1, H, W) for
        networks of grey images.
        """
        outputs: dict[int, Tensor] = {-1: pixels}
        *layers, _head = self.architecture.layers
        for index, (layer, module) in enumerate(zip(layers, self.model[:-1], strict=True)):
            inputs = [outputs[source] for source in self._sources[index]]
            outputs[index] = module(inputs if layer.kind == "Concat" else inputs[0])
            del inputs
            for source in self._last_read[index]:
                del outputs[source]
        return [outputs[source] for source in self._sources[len(layers)]]

    def heads(self, pixels: Tensor) -> list[Tensor]:
        """Logits of each level, (B, anchors, ny, nx, 5 + C + M), for training. `pixels` as for `features`."""
        logits: list[Tensor] = self.head(self.features(pixels))
        return logits

    def forward(self, pixels: Tensor) -> Tensor:
        """Predictions (B, N, 5 + C + M), see `predictions`. `pixels` as for `features`."""
        return self.predictions(self.features(pixels))

    def predictions(self, features: list[Tensor]) -> Tensor:
        """Predictions (B, N, 5 + C + M) from the features of all levels.

        cx, cy, w, h in network pixels, objectness and class scores in [0, 1]; if the network segments, the M
        coefficients of a mask. Decoded in float32 whatever the layers' dtype: fp16 resolves a box at x = 600
        only to half a pixel. Training mode returns the same format.
        """
        return self.head.decode([level.float() for level in self.head(features)])


def fuse(network: Module) -> Module:
    """Fold every normalisation of `network`, or of a part of one, into its convolution, in place.

    Also rewrites blocks that can be computed faster in another way; see `Block.fold`.
    """
    network.eval()
    for module in list(network.modules()):
        if isinstance(module, Block):
            module.fold()
    return network.requires_grad_(False)


def _absolute_sources(architecture: Architecture) -> list[list[int]]:
    """The layers that each layer reads; -1 are the pixels."""
    return [
        [index - 1 if source == -1 else source for source in layer.sources]
        for index, layer in enumerate(architecture.layers)
    ]


def _last_read(sources: list[list[int]]) -> list[list[int]]:
    """For each layer those of its sources, itself included, that no later layer reads."""
    last = {index: index for index in range(-1, len(sources))}
    for reader, read in enumerate(sources):
        last.update(dict.fromkeys(read, reader))
    return [[source for source, reader in last.items() if reader == index] for index in range(len(sources))]


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
    if layer.kind in HEADS:
        return HEADS[layer.kind](architecture, channels_in), 0
    if layer.kind in RESIZING:
        module = RESIZING[layer.kind](*layer.args)
        return module, channels_after(module, channels_in[0])
    unscaled, *arguments = layer.args
    assert isinstance(unscaled, int)
    channels_out = architecture.scaled_channels(unscaled)
    block = LAYER_KINDS[layer.kind]
    repeats = layer.scaled_repeats(architecture.depth_multiple)
    if getattr(block, "has_repeats_inside", False):  # torch's own have no such attribute
        return block(channels_in[0], channels_out, repeats, *arguments), channels_out
    if repeats == 1:
        return block(channels_in[0], channels_out, *arguments), channels_out
    if channels_in[0] != channels_out:
        raise ValueError(f"a {layer.kind} of {channels_in[0]} to {channels_out} channels cannot be repeated")
    return nn.Sequential(
        *(block(channels_out, channels_out, *arguments) for _ in range(repeats))
    ), channels_out


def _set_activations(network: nn.Module, architecture: Architecture) -> None:
    """Replace SiLU by the activations of `architecture`; modules without one stay without."""
    others = dict(architecture.other_activations)
    for path, module in list(network.named_modules()):
        if isinstance(act := getattr(module, "act", None), nn.Module):
            usual = architecture.activation if isinstance(act, nn.SiLU) else "Identity"
            module.act = activation_of(others.pop(f"{path}.act", usual))
    if others:
        raise ValueError(f"there is no activation at {next(iter(others))[:100]}")
