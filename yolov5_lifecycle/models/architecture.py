"""YOLOv5 architectures as immutable values."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal, NamedTuple, Union, get_args

Size = Literal["n", "s", "m", "l", "x", "n6", "s6", "m6", "l6", "x6"]
AnchorsPx = tuple[tuple[tuple[float, float], ...], ...]
Argument = Union[int, float, tuple[int, ...], None]  # noqa: UP007 - the new form cannot be evaluated by 3.10
"""An argument of a layer; None stands for its default."""


class Layer(NamedTuple):
    """One network layer: a module of `kind` fed by the layers `sources` (indices; -1 is the previous one).

    `kind` is the name of the module's class. `repeats` is before the depth multiple. `args` are those that
    the class takes, as in a checkpoint's yaml: for most kinds they start with the output channels before the
    width multiple, such as Conv (channels, kernel, stride), C3 (channels, shortcut), SPPF (channels, kernel).
    """

    sources: tuple[int, ...]
    repeats: int
    kind: str
    args: tuple[Argument, ...] = ()

    def scaled_repeats(self, depth_multiple: float) -> int:
        """Number of repeats after applying the depth multiple."""
        return max(round(self.repeats * depth_multiple), 1) if self.repeats > 1 else 1


def _layer(sources: int | tuple[int, ...], repeats: int, kind: str, *args: int) -> Layer:
    return Layer((sources,) if isinstance(sources, int) else sources, repeats, kind, args)


_STEM = (
    _layer(-1, 1, "Conv", 64, 6, 2),
    _layer(-1, 1, "Conv", 128, 3, 2),
    _layer(-1, 3, "C3", 128),
    _layer(-1, 1, "Conv", 256, 3, 2),
    _layer(-1, 6, "C3", 256),
    _layer(-1, 1, "Conv", 512, 3, 2),
    _layer(-1, 9, "C3", 512),
)


def _up(channels: int, source: int) -> tuple[Layer, ...]:
    """Layers that join twice the size of the previous layer with the layer `source`."""
    return (
        _layer(-1, 1, "Conv", channels, 1, 1),
        _layer(-1, 1, "Upsample"),
        _layer((-1, source), 1, "Concat"),
        _layer(-1, 3, "C3", channels, False),
    )


def _down(channels: int, source: int, channels_out: int) -> tuple[Layer, ...]:
    """Layers that join half the size of the previous layer with the layer `source`."""
    return (
        _layer(-1, 1, "Conv", channels, 3, 2),
        _layer((-1, source), 1, "Concat"),
        _layer(-1, 3, "C3", channels_out, False),
    )


P5_LAYERS = (
    *_STEM,
    _layer(-1, 1, "Conv", 1024, 3, 2),
    _layer(-1, 3, "C3", 1024),
    _layer(-1, 1, "SPPF", 1024, 5),
    *_up(512, 6),
    *_up(256, 4),
    *_down(256, 14, 512),
    *_down(512, 10, 1024),
    _layer((17, 20, 23), 1, "Detect"),
)

P6_LAYERS = (
    *_STEM,
    _layer(-1, 1, "Conv", 768, 3, 2),
    _layer(-1, 3, "C3", 768),
    _layer(-1, 1, "Conv", 1024, 3, 2),
    _layer(-1, 3, "C3", 1024),
    _layer(-1, 1, "SPPF", 1024, 5),
    *_up(768, 8),
    *_up(512, 6),
    *_up(256, 4),
    *_down(256, 20, 512),
    *_down(512, 16, 768),
    *_down(768, 12, 1024),
    _layer((23, 26, 29, 32), 1, "Detect"),
)


@dataclass(frozen=True, kw_only=True)
class Architecture:
    """A YOLOv5 architecture of any version: layers, scaling factors and activations.

    `anchors_px` are (width, height) in network pixels, one row of anchors per detection level; `strides` are
    the network pixels per grid cell of each level. The last layer is the head, Detect or Segment, and has
    one source per level. `image_channels` is 3 for RGB, 1 for grey. `activation`, a name in
    `models/convolutions.py`, is that of every convolution that has one; `other_activations` are pairs of a
    module's path in the network and its different activation. If it `is_fused`, convolutions have a
    bias and no normalisation.
    """

    depth_multiple: float
    width_multiple: float
    classes: int
    anchors_px: AnchorsPx
    strides: tuple[int, ...]
    layers: tuple[Layer, ...] = P5_LAYERS
    image_channels: int = 3
    channel_multiple: int = 8
    activation: str = "SiLU"
    other_activations: tuple[tuple[str, str], ...] = ()
    is_fused: bool = False

    @property
    def head_outputs(self) -> int:
        """Channels of each convolution of a Detect layer: for every anchor 5 numbers and the classes."""
        return len(self.anchors_px[0]) * (5 + self.classes)

    @property
    def mask_coefficients(self) -> int:
        """Coefficients of the mask of each prediction; 0 for a network that does not segment."""
        return self._of_segment(0)

    @property
    def prototype_channels(self) -> int:
        """Channels in which a segmentation network computes its prototypes."""
        return self._divisible(self._of_segment(1))

    def _of_segment(self, argument: int) -> int:
        head = self.layers[-1]
        value = head.args[argument] if head.kind == "Segment" else 0
        assert isinstance(value, int)
        return value

    def scaled_channels(self, channels: int) -> int:
        """Number of channels after applying the width multiple.

        As in YOLOv5, a number that happens to equal the head's number of outputs is not scaled.
        """
        if channels == self.head_outputs:
            return channels
        return self._divisible(channels)

    def _divisible(self, channels: int) -> int:
        return math.ceil(channels * self.width_multiple / self.channel_multiple) * self.channel_multiple


_P5_ANCHORS_PX: AnchorsPx = (
    ((10, 13), (16, 30), (33, 23)),
    ((30, 61), (62, 45), (59, 119)),
    ((116, 90), (156, 198), (373, 326)),
)
_P6_ANCHORS_PX: AnchorsPx = (
    ((19, 27), (44, 40), (38, 94)),
    ((96, 68), (86, 152), (180, 137)),
    ((140, 301), (303, 264), (238, 542)),
    ((436, 615), (739, 380), (925, 792)),
)
_MULTIPLES = {"n": (0.33, 0.25), "s": (0.33, 0.50), "m": (0.67, 0.75), "l": (1.0, 1.0), "x": (1.33, 1.25)}


def _official(size: str) -> Architecture:
    depth_multiple, width_multiple = _MULTIPLES[size[0]]
    has_p6 = size.endswith("6")
    return Architecture(
        depth_multiple=depth_multiple,
        width_multiple=width_multiple,
        classes=80,
        anchors_px=_P6_ANCHORS_PX if has_p6 else _P5_ANCHORS_PX,
        strides=(8, 16, 32, 64) if has_p6 else (8, 16, 32),
        layers=P6_LAYERS if has_p6 else P5_LAYERS,
    )


SIZES: Mapping[str, Architecture] = MappingProxyType({size: _official(size) for size in get_args(Size)})
"""The ten official architectures (80 classes) by size."""


def image_size_problem(image_size: int, stride: int, *, whose: str) -> str:
    """Error text if `image_size` is not a multiple of `stride`, the largest of `whose`; else ""."""
    if image_size >= stride and image_size % stride == 0:
        return ""
    below = max(image_size // stride, 1) * stride
    return (
        f"{image_size} is not a multiple of {stride}, the largest stride of {whose}. "
        f"Use {below} or {below + stride}."
    )
