"""Small architectures: some in which every kind of layer occurs, and some that no machine could run."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

from support.checkpoint_builder import SMALL, official_model, saved, stripped
from yolov5_lifecycle.models.architecture import Architecture, Layer


def _with(layers: Mapping[int, Layer], **changes: object) -> Architecture:
    """SMALL with other layers at some places."""
    changed = tuple(layers.get(index, layer) for index, layer in enumerate(SMALL.layers))
    return dataclasses.replace(SMALL, layers=changed, **changes)  # type: ignore[arg-type]  # of any field


def _layer(
    kind: str, *args: int | tuple[int, ...], repeats: int = 1, sources: tuple[int, ...] = (-1,)
) -> Layer:
    return Layer(sources, repeats, kind, args)


SMALL_FAMILIES: Mapping[str, Architecture] = {
    "cross-stage": _with(
        {
            2: _layer("BottleneckCSP", 64, repeats=3),
            4: _layer("SPP", 64, (3, 5)),
            7: _layer("BottleneckCSP", 64),
        },
        activation="LeakyReLU(0.1)",
    ),
    "ghost": _with(
        {
            2: _layer("C3Ghost", 64),
            3: _layer("GhostBottleneck", 64, 3, 2),
            4: _layer("GhostConv", 64, 3),
            7: _layer("GhostConv", 64),
        },
        activation="ReLU",
    ),
    "transformer": _with(
        {2: _layer("C3TR", 64, repeats=6), 4: _layer("C3SPP", 64, (5,)), 7: _layer("C3x", 64)},
        activation="Hardswish",
    ),
    "convolutions": _with(
        {
            2: _layer("MixConv2d", 64),
            3: _layer("DWConv", 64, 3, 2),
            4: _layer("CrossConv", 64, 3, 1, 1, 1, 1),
            5: _layer("ConvTranspose2d", 64, 2, 2),
            7: _layer("Bottleneck", 64, 0),
        },
        other_activations=(("model.0.act", "Identity"), ("model.2.act", "LeakyReLU(0.1)")),
    ),
    "segmentation": _with({8: Layer((7, 4), 1, "Segment", (8, 64))}),
}
"""Those with the layers of SMALL, but for their kinds."""

RESIZED = dataclasses.replace(
    SMALL,
    image_channels=1,
    layers=(
        _layer("Focus", 64, 3),
        _layer("ZeroPad2d", (0, 1, 0, 1)),
        _layer("MaxPool2d", 2, 1, 0),
        _layer("Conv", 64, 3, 2),
        _layer("Bottleneck", 64, repeats=6),
        _layer("Conv", 64, 3, 2),
        _layer("SPPF", 64, 5),
        _layer("DWConvTranspose2d", 64, 4, 2, 1),
        Layer((-1, 4), 1, "Concat"),
        _layer("Contract", 2),
        _layer("Expand", 2),
        _layer("C3", 64, 0),
        Layer((11, 6), 1, "Detect"),
    ),
)
"""One with the kinds that change the size of what they read."""
EVERY_SMALL: Mapping[str, Architecture] = SMALL_FAMILIES | {"resized": RESIZED}  # type: ignore[operator]


_JOIN = _layer("Concat", sources=(-1,) * 16)
_UP, _EIGHTH = _layer("Upsample"), _layer("MaxPool2d", 8, 8, 0)
_BEFORE_HEAD = len(SMALL.layers) - 1


def _longer(*layers: Layer) -> Architecture:
    """SMALL with more layers before the head, which reads none of them."""
    return dataclasses.replace(SMALL, layers=(*SMALL.layers[:-1], *layers, SMALL.layers[-1]))


_MANY_KEPT = _longer(
    *(_UP, _UP),
    *[_layer("Concat", sources=(_BEFORE_HEAD + 1,) * 16)] * 24,
    *(_layer("MaxPool2d", 2, 2, 0, sources=(_BEFORE_HEAD + 2 + index,)) for index in range(24)),
)
_MANY_PREDICTIONS = dataclasses.replace(
    SMALL,
    classes=10_000,
    anchors_px=(tuple((8.0 + anchor, 8.0) for anchor in range(32)),),
    strides=(2,),
    layers=(_layer("Conv", 64, 6, 2), _layer("Detect", sources=(0,))),
)

COSTLY: Mapping[str, tuple[Architecture, str]] = {
    "five times 16 equal inputs": (
        _longer(*[_JOIN] * 5),
        "layer 10 (Concat) would have 33,554,432 elements for an image of 128x128, at most 4,194,304",
    ),
    "squares that become channels": (
        _longer(_layer("Contract", 8), _layer("Contract", 8), _layer("Concat", sources=(9,) * 4)),
        "layer 10 (Concat) would have 131,072 channels, at most 65,536",
    ),
    "six times twice the size": (
        _longer(*[_UP] * 6, _EIGHTH, _EIGHTH),
        "layer 12 (Upsample) would have 8,388,608 elements for an image of 128x128, at most 4,194,304",
    ),
    "transposed convolutions": (
        _longer(*[_layer("ConvTranspose2d", 64, 8, 8)] * 3),
        "layer 9 (ConvTranspose2d) would have 33,554,432 elements",
    ),
    "24 large layers that are read again": (_MANY_KEPT, "layer 34 (MaxPool2d) would keep 208 MB of features"),
    "10,000 classes, 32 anchors for every second pixel": (
        _MANY_PREDICTIONS,
        "layer 1 (Detect) would keep 15.7 GB of features and predictions for an image of 128x128, at most",
    ),
}
"""Small ones that would take up the memory or the time of any machine, and what their refusal says."""


def segmentation_checkpoint() -> bytes:
    """A small segmentation model as YOLOv5 saves it."""
    return saved(stripped(official_model(SMALL_FAMILIES["segmentation"])))
