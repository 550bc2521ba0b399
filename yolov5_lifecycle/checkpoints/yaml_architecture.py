"""Conversion of a YOLOv5 checkpoint's `yaml` to an Architecture: its layers, and why others are refused."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any

from yolov5_lifecycle.models.architecture import AnchorsPx, Architecture, Argument, Layer
from yolov5_lifecycle.models.convolutions import LAYER_KINDS
from yolov5_lifecycle.models.cost import MAX_STRIDE, check_architecture, nearest_stride, strides_of
from yolov5_lifecycle.models.head import HEADS
from yolov5_lifecycle.models.model import WeightsError, checked_integer, shown

MAX_LAYERS = 200
MAX_REPEATS = 100
MAX_BLOCKS = 400
"""Sum of the repeats of all layers with weights; the largest official network, x6, has 80."""
MAX_LEVELS = 8
MAX_ANCHORS = 32
_MAX_CHANNEL_MULTIPLE = 256
MAX_CHANNELS = 8192
MAX_COEFFICIENTS = 256
"""Max coefficients of a mask, thus prototypes; YOLOv5's own models have 32."""
MAX_KERNEL = 15
MAX_LAYER_STRIDE = 8
_MAX_GROUPS = 8192
_MAX_WINDOWS = 8


def architecture_of(
    yaml: object, *, classes: int, anchors_px: AnchorsPx, strides: tuple[int, ...]
) -> Architecture:
    """The architecture from the `backbone` and `head` rows and multiples, validated; raises WeightsError.

    The activations are those of `Architecture` by default.
    """
    if not isinstance(yaml, dict):
        raise WeightsError(f"expected a dict as the model's yaml, found {shown(yaml)}")
    channels = yaml.get("ch", Architecture.image_channels)
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
        found, multiple = strides_of(architecture)
    except ValueError as error:
        raise WeightsError(str(error)) from None
    if found != architecture.strides:
        made = [
            str(near) if near == stride else f"{near}, not whole"
            for stride, near in zip(found, map(nearest_stride, found), strict=True)
        ]
        raise WeightsError(
            f"the strides are {shown(architecture.strides)}, but its layers produce {shown(made)}"
        )
    if multiple > MAX_STRIDE:
        raise WeightsError(f"its layers have strides above {MAX_STRIDE}: no model needs that")


def _check_cost(architecture: Architecture) -> None:
    try:
        check_architecture(architecture)
    except WeightsError:
        raise
    except ValueError as error:
        raise WeightsError(f"{error}: no model needs that") from None


@dataclass(frozen=True)
class Given:
    """An argument of a row: `read(value, where)` validates its value; `where` is for messages.

    An argument that `is_kept` is part of the layer even if it has its default value.
    """

    read: Callable[[object, str], Argument]
    default: Argument = None
    is_required: bool = False
    is_kept: bool = False


def _arguments_of(row: Sequence[object], expected: Sequence[Given], where: str) -> tuple[Argument, ...]:
    """The arguments of a layer, without those at the end that have their default value.

    Raises WeightsError for a value out of its range, ValueError for anything else that is wrong: the catcher
    quotes the whole row.
    """
    if len(row) > len(expected):
        raise ValueError
    # A missing number is refused like a value that is not a number.
    values = [
        given.read(row[number] if number < len(row) else None, where)
        if number < len(row) or given.is_required
        else given.default
        for number, given in enumerate(expected)
    ]
    while values and _is_implied(expected[len(values) - 1], values[-1]):
        values.pop()
    return tuple(values)


def _is_implied(given: Given, value: Argument) -> bool:
    return not given.is_required and not given.is_kept and value == given.default


def _whole(what: str, least: int, most: int) -> Callable[[object, str], int]:
    return lambda value, where: checked_integer(value, f"the {what} of {where}", least, most)


def _odd_kernel(value: object, where: str) -> int:
    """An odd kernel: with an even one, output and input would differ in size."""
    kernel = checked_integer(value, f"the kernel of {where}", 1, MAX_KERNEL)
    if kernel % 2 == 0:
        raise ValueError
    return kernel


def _shortcut(value: object, where: str) -> int:
    if not isinstance(value, (bool, int)) or value not in (0, 1):
        raise ValueError
    return int(value)


def _expansion(value: object, where: str) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0.01 <= value <= 4:
        raise ValueError
    return float(value)


def _padding(value: object, where: str) -> int | None:
    return None if value in (None, "None") else _whole("padding", 0, MAX_KERNEL)(value, where)


def _dilation(value: object, where: str) -> int:
    # Until v6.2 the activation is here; it is read from the modules.
    return 1 if isinstance(value, (bool, str)) else _whole("dilation", 1, 8)(value, where)


def _activation(value: object, where: str) -> None:
    """Ignored: the activation is read from each module."""
    if not isinstance(value, (bool, str)) and value is not None:
        raise ValueError


def _windows(value: object, where: str) -> tuple[int, ...]:
    """Window sizes that ascend."""
    if not isinstance(value, (list, tuple)) or not 1 <= len(value) <= _MAX_WINDOWS:
        raise ValueError
    windows = tuple(_odd_kernel(window, where) for window in value)
    if windows != tuple(sorted(windows)):
        raise ValueError
    return windows


def _sides(value: object, where: str) -> tuple[int, ...]:
    """Padding left, right, top and bottom; horizontally as much as vertically, to keep the proportions."""
    if not isinstance(value, (list, tuple)) or len(value) != 4:
        raise ValueError
    sides = tuple(_whole("padding", 0, MAX_LAYER_STRIDE)(side, where) for side in value)
    if sides[0] + sides[1] != sides[2] + sides[3]:
        raise ValueError
    return sides


def only(*accepted: object) -> Given:
    """An argument that must be one of `accepted` and has no effect."""

    def read(value: object, where: str) -> None:
        if isinstance(value, bool) or value not in accepted:
            raise ValueError

    return Given(read)


CHANNELS = Given(_whole("channels", 1, MAX_CHANNELS), is_required=True)
COEFFICIENTS = Given(_whole("coefficients of masks", 1, MAX_COEFFICIENTS), 32, is_kept=True)
PROTOTYPE_CHANNELS = Given(_whole("channels of prototypes", 1, MAX_CHANNELS), 256, is_kept=True)
KERNEL = Given(_whole("kernel", 1, MAX_KERNEL), 1)
ODD_KERNEL = Given(_odd_kernel, 1)
STRIDE = Given(_whole("stride", 1, MAX_LAYER_STRIDE), 1)
PADDING = Given(_padding)
GROUPS = Given(_whole("groups", 1, _MAX_GROUPS), 1)
DILATION = Given(_dilation, 1)
ACTIVATION = Given(_activation)
SHORTCUT = Given(_shortcut, 1)
EXPANSION = Given(_expansion, 0.5)
WINDOWS = Given(_windows)
SIDES = Given(_sides, is_required=True)
GAIN = Given(_whole("gain", 2, MAX_LAYER_STRIDE), is_required=True)
NO_PADDING = Given(_whole("padding", 0, MAX_KERNEL), 0)
_PARTIAL = (CHANNELS, SHORTCUT, GROUPS, EXPANSION)
_KEPT_KERNEL, _KEPT_STRIDE = replace(KERNEL, is_kept=True), replace(STRIDE, is_kept=True)
_POOL_STRIDE = replace(STRIDE, is_required=True)
_WHOLE_EXPANSION, _NO_SHORTCUT = replace(EXPANSION, default=1.0), replace(SHORTCUT, default=0)
_ODD_3 = replace(ODD_KERNEL, default=3)


ROWS: Mapping[str, Sequence[Given]] = MappingProxyType(
    {
        "Conv": (CHANNELS, _KEPT_KERNEL, _KEPT_STRIDE, PADDING, GROUPS, DILATION, ACTIVATION),
        "DWConv": (CHANNELS, ODD_KERNEL, STRIDE, DILATION, ACTIVATION),
        "Focus": (CHANNELS, ODD_KERNEL, STRIDE, only(None, "None"), only(1), ACTIVATION),
        "GhostConv": (CHANNELS, ODD_KERNEL, STRIDE, GROUPS, ACTIVATION),
        "GhostBottleneck": (CHANNELS, _ODD_3, STRIDE),
        "Bottleneck": _PARTIAL,
        "CrossConv": (CHANNELS, _ODD_3, STRIDE, GROUPS, _WHOLE_EXPANSION, _NO_SHORTCUT),
        "MixConv2d": (CHANNELS, replace(WINDOWS, default=(1, 3)), STRIDE),
        "C3": _PARTIAL,
        "C3x": _PARTIAL,
        "C3TR": _PARTIAL,
        "C3Ghost": _PARTIAL,
        "C3SPP": (CHANNELS, replace(WINDOWS, default=(5, 9, 13))),
        "BottleneckCSP": _PARTIAL,
        "SPP": (CHANNELS, replace(WINDOWS, default=(5, 9, 13))),
        "SPPF": (CHANNELS, replace(ODD_KERNEL, default=5, is_kept=True)),
        "ConvTranspose2d": (CHANNELS, replace(KERNEL, is_required=True), STRIDE, NO_PADDING, NO_PADDING),
        "DWConvTranspose2d": (CHANNELS, KERNEL, STRIDE, NO_PADDING, NO_PADDING),
        "Upsample": (only(None, "None"), only(2), only("nearest")),
        "MaxPool2d": (replace(KERNEL, is_required=True), _POOL_STRIDE, replace(NO_PADDING, is_kept=True)),
        "ZeroPad2d": (SIDES,),
        "Contract": (GAIN,),
        "Expand": (GAIN,),
        "Concat": (only(1),),
        "Detect": (),
        "Segment": (COEFFICIENTS, PROTOTYPE_CHANNELS),
    }
)
"""Arguments by kind of layer; for heads without classes and anchors, which are read from attributes."""
_FOREIGN_KINDS = {
    "Classify": "the head of a classification model; only models that detect or segment are supported: use "
    "yolov5s.pt instead of yolov5s-cls.pt, say",
    "NMS": "which YOLOv5 before 6.0 added for an export: use the checkpoint of the training",
    **dict.fromkeys(
        ("IDetect", "IAuxDetect", "IBin", "MP", "SPPCSPC", "SPPFCSPC", "RepConv"),
        "of another project, named YOLOv7; only YOLOv5 and the YOLOv3 that it trains are supported",
    ),
    **dict.fromkeys(
        ("Sum", "BatchNorm2d", "Conv2d", "TransformerBlock", "Proto"),
        "which YOLOv5 has, but none of its models uses as a layer: not supported",
    ),
}


def layer_kind(name: str, where: str) -> str:
    """The kind of a module named `name`; raises WeightsError with a description of unsupported ones."""
    kind = name.removeprefix("nn.")
    if kind in ROWS:
        return kind
    why = _FOREIGN_KINDS.get(kind, f"not supported; supported are {', '.join(ROWS)}")
    raise WeightsError(f"{where} is a {shown(kind)}, {why}")


def layer_arguments(kind: str, row: Sequence[object], where: str) -> tuple[Argument, ...]:
    """`Layer.args` of the arguments in a row of the yaml; raises WeightsError."""
    if kind == "Detect":
        return ()
    if kind == "Segment":
        row = row[2:]  # after classes and anchors
    try:
        arguments = _arguments_of(row, ROWS[kind], where)
        return _padded(arguments) if kind == "Conv" else arguments
    except WeightsError:
        raise
    except ValueError:
        raise WeightsError(f"{where}, a {kind}, has the arguments {shown(row)}: not supported") from None


def _padded(arguments: tuple[Argument, ...]) -> tuple[Argument, ...]:
    """The arguments of Conv, with the padding of YOLOv5 where it is not that of our Conv."""
    _, kernel, stride = arguments[:3]
    padding = arguments[3] if len(arguments) > 3 else None
    dilation = arguments[5] if len(arguments) > 5 else 1
    assert isinstance(kernel, int)
    assert isinstance(dilation, int)
    if kernel % 2 == 0 and stride == 1:  # the output has another size than the input
        raise ValueError
    wanted = (dilation * (kernel - 1) + 1) // 2 if padding is None else padding
    if wanted != dilation * (kernel - 1) // 2:
        return (*arguments[:3], wanted, *arguments[4:])
    return (*arguments[:3], None, *arguments[4:]) if arguments[4:] else arguments[:3]
