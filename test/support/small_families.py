"""Small architectures in which every kind of layer occurs, quick to write and to read."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

from support.checkpoint_builder import SMALL, official_model, saved, stripped
from yolov5_lifecycle.models.architecture import Architecture, Layer


def _with(layers: Mapping[int, Layer], **changes: object) -> Architecture:
    """SMALL with other layers at some places."""
    changed = tuple(layers.get(index, layer) for index, layer in enumerate(SMALL.layers))
    return dataclasses.replace(SMALL, layers=changed, **changes)  # type: ignore[arg-type]  # of any field


def _layer(kind: str, *args: int | tuple[int, ...], repeats: int = 1) -> Layer:
    return Layer((-1,), repeats, kind, args)


SMALL_FAMILIES: Mapping[str, Architecture] = {
    "cross-stage": _with(
        {2: _layer("BottleneckCSP", 64, repeats=3), 4: _layer("SPP", 64, (3, 5)), 7: _layer("CrossCSP", 64)},
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
        {2: _layer("C3TR", 64, repeats=6), 4: _layer("C3SPP", 64, (3, 5)), 7: _layer("C3x", 64)},
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
        _layer("DWConvTranspose2d", 64, 2, 2),
        Layer((-1, 4), 1, "Concat"),
        _layer("Contract", 2),
        _layer("Expand", 2),
        _layer("C3", 64, 0),
        Layer((11, 6), 1, "Detect"),
    ),
)
"""One with the kinds that change the size of what they read."""
EVERY_SMALL: Mapping[str, Architecture] = SMALL_FAMILIES | {"resized": RESIZED}  # type: ignore[operator]


def segmentation_checkpoint() -> bytes:
    """A small segmentation model as YOLOv5 saves it."""
    architecture = SMALL_FAMILIES["segmentation"]
    return saved(stripped(official_model(architecture, kind="models.yolo.SegmentationModel")))
