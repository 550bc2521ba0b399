"""Conversion of a YOLOv5 checkpoint's `yaml` to an Architecture."""

from __future__ import annotations

import math
from collections.abc import Sequence
from fractions import Fraction
from typing import Any

from yolov5_lifecycle.checkpoints.layer_rows import layer_arguments, layer_kind
from yolov5_lifecycle.models.architecture import AnchorsPx, Architecture, Layer
from yolov5_lifecycle.models.convolutions import LAYER_KINDS
from yolov5_lifecycle.models.cost import Cells, cells_of_levels, check_architecture
from yolov5_lifecycle.models.head import HEADS
from yolov5_lifecycle.models.model import WeightsError, checked_integer, shown

MAX_LAYERS = 200
MAX_REPEATS = 100
MAX_BLOCKS = 400
"""Sum of the repeats of all layers with weights; the largest official network, x6, has 80."""
MAX_LEVELS = 8
MAX_STRIDE = 1024
MAX_ANCHORS = 32
_MAX_CHANNEL_MULTIPLE = 256


def architecture_of(
    yaml: object, *, classes: int, anchors_px: AnchorsPx, strides: tuple[int, ...], image_channels: int = 3
) -> Architecture:
    """The architecture from the `backbone` and `head` rows and multiples, validated; raises WeightsError.

    `image_channels` counts where the yaml has no entry `ch`, as before v6.0. The activations are those of
    `Architecture` by default.
    """
    if not isinstance(yaml, dict):
        raise WeightsError(f"expected a dict as the model's yaml, found {shown(yaml)}")
    channels = yaml.get("ch", image_channels)
    if isinstance(channels, bool) or not isinstance(channels, int) or channels not in (1, 3):
        raise WeightsError(
            f"the model reads images of {shown(channels)} channels; only models for colour images, of 3, and "
            "for grey ones, of 1, are supported: train it on those"
        )
    rows = [*_rows(yaml, "backbone"), *_rows(yaml, "head")]
    if not 1 <= len(rows) <= MAX_LAYERS:
        raise WeightsError(f"expected 1 to {MAX_LAYERS} layers, found {len(rows)}")
    architecture = Architecture(
        depth_multiple=_multiple(yaml, "depth_multiple"),
        width_multiple=_multiple(yaml, "width_multiple"),
        channel_multiple=checked_integer(
            yaml.get("channel_multiple", 8), "the channel_multiple", 1, _MAX_CHANNEL_MULTIPLE
        ),
        classes=classes,
        anchors_px=anchors_px,
        strides=strides,
        layers=tuple(_layer(row, index) for index, row in enumerate(rows)),
        image_channels=channels,
    )
    _check_repeats(architecture)
    _check_strides(architecture)
    _check_cost(architecture)
    return architecture


def layer_sources(sources: object, index: int) -> tuple[int, ...]:
    """Indices of earlier layers; negative ones are made absolute, except -1."""
    listed = list(sources) if isinstance(sources, (list, tuple)) else [sources]
    if not 1 <= len(listed) <= 16:
        raise WeightsError(f"layer {index} reads {len(listed)} layers, expected 1 to 16")
    numbers = [
        checked_integer(source, f"the input of layer {index}", -max(index, 1), index - 1) for source in listed
    ]
    return tuple(number if number >= -1 else index + number for number in numbers)


def _rows(yaml: dict[Any, Any], part: str) -> Sequence[object]:
    rows = yaml.get(part)
    if not isinstance(rows, (list, tuple)):
        raise WeightsError(f"expected a list of layers as {part} of the model's yaml, found {shown(rows)}")
    return rows


def _multiple(yaml: dict[Any, Any], key: str) -> float:
    value = yaml.get(key)
    if not isinstance(value, (int, float)) or not math.isfinite(value) or not 0.01 <= value <= 10:
        raise WeightsError(f"expected a {key} from 0.01 to 10, found {shown(value)}")
    return float(value)


def _layer(row: object, index: int) -> Layer:
    if not isinstance(row, (list, tuple)) or len(row) != 4 or not isinstance(row[3], (list, tuple)):
        raise WeightsError(f"expected [from, number, module, arguments] as layer {index}, found {shown(row)}")
    sources, repeats, module, arguments = row
    kind = layer_kind(module if isinstance(module, str) else shown(module), f"layer {index}")
    layer = Layer(
        sources=layer_sources(sources, index),
        repeats=checked_integer(repeats, f"the number of layer {index}", 1, MAX_REPEATS),
        kind=kind,
        args=layer_arguments(kind, arguments, f"layer {index}"),
    )
    if len(layer.sources) > {"Concat": 16, **dict.fromkeys(HEADS, MAX_LEVELS)}.get(kind, 1):
        raise WeightsError(f"layer {index}, a {kind}, reads too many layers: {shown(layer.sources)}")
    return layer


def _check_repeats(architecture: Architecture) -> None:
    """Limit the blocks that are built, and reject repeats of layers that cannot be repeated."""
    blocks = 0
    for index, layer in enumerate(architecture.layers):
        repeats = layer.scaled_repeats(architecture.depth_multiple)
        if repeats > 1 and layer.kind not in LAYER_KINDS:
            raise WeightsError(f"layer {index}, a {layer.kind}, is repeated {repeats} times: not supported")
        blocks += repeats if layer.kind in LAYER_KINDS else 0
    if blocks > MAX_BLOCKS:
        raise WeightsError(f"it has {blocks} blocks, at most {MAX_BLOCKS} are built")


def _check_strides(architecture: Architecture) -> None:
    """Check that concatenated inputs have equal sizes and that the last layer, the head, gets `strides`."""
    heads = [index for index, layer in enumerate(architecture.layers) if layer.kind in HEADS]
    if heads != [len(architecture.layers) - 1]:
        raise WeightsError(f"expected one {' or '.join(HEADS)} layer, the last, found {len(heads)}")
    try:
        found, multiple = cells_of_levels(architecture)
    except ValueError as error:
        raise WeightsError(str(error)) from None
    if found != tuple(Cells(Fraction(stride)) for stride in architecture.strides):
        made = [str(level.pixels) if level.surplus == 0 else f"{level.pixels}, not whole" for level in found]
        raise WeightsError(
            f"the strides are {shown(architecture.strides)}, but its layers produce {shown(made)}"
        )
    if multiple > MAX_STRIDE:
        raise WeightsError(f"its layers have strides up to {multiple}, at most {MAX_STRIDE} are supported")


def _check_cost(architecture: Architecture) -> None:
    try:
        check_architecture(architecture)
    except WeightsError:
        raise
    except ValueError as error:
        raise WeightsError(f"{error}: no model needs that") from None
