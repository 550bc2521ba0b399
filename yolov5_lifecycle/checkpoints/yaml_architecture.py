"""Conversion of a YOLOv5 checkpoint's `yaml` to an Architecture."""

from __future__ import annotations

import math
from collections.abc import Sequence
from fractions import Fraction
from typing import Any

from yolov5_lifecycle.models.architecture import LAYER_KINDS, AnchorsPx, Architecture, Layer, LayerKind
from yolov5_lifecycle.models.model import WeightsError, checked_integer, shown

MAX_LAYERS = 200
MAX_CHANNELS = 8192
MAX_REPEATS = 100
MAX_BOTTLENECKS = 300
"""Sum over all C3 layers; the largest official network, x6, has 56."""
MAX_LEVELS = 8
MAX_STRIDE = 1024
MAX_ANCHORS = 32

_FOREIGN_KINDS = {
    **dict.fromkeys(("Focus", "BottleneckCSP", "SPP"), "of YOLOv5 before 6.0: train it again with v6 or v7"),
    "Segment": "the head of a segmentation model; only detection models are supported: use yolov5s.pt "
    "instead of yolov5s-seg.pt, say",
    "Classify": "the head of a classification model; only detection models are supported: use yolov5s.pt "
    "instead of yolov5s-cls.pt, say",
    "NMS": "which YOLOv5 before 6.0 added for an export: use the checkpoint of the training",
    **dict.fromkeys(
        ("Bottleneck", "MaxPool2d", "ZeroPad2d"),
        "as in a YOLOv3 model, which YOLOv5's code can train, too; only YOLOv5 (v6 or v7) is supported",
    ),
    **dict.fromkeys(
        ("IDetect", "IAuxDetect", "IBin", "MP", "SPPCSPC", "SPPFCSPC", "RepConv"),
        "of another project, named YOLOv7; only YOLOv5 (v6 or v7) is supported",
    ),
    **dict.fromkeys(
        (
            *("C3TR", "C3SPP", "C3Ghost", "C3x", "GhostConv", "GhostBottleneck", "DWConv", "CrossConv"),
            *("DWConvTranspose2d", "ConvTranspose2d", "MixConv2d", "Contract", "Expand", "Sum"),
        ),
        "a variant of YOLOv5's building blocks that is not supported: use a model of the sizes n to x or n6 "
        "to x6",
    ),
}
_FIXED_ARGUMENTS: dict[LayerKind, list[list[object]]] = {
    "Upsample": [[None, 2, "nearest"], ["None", 2, "nearest"]],
    "Concat": [[1]],
}


def architecture_of(
    yaml: object, *, classes: int, anchors_px: AnchorsPx, strides: tuple[int, ...]
) -> Architecture:
    """The architecture from the `backbone` and `head` rows and multiples, validated; raises WeightsError."""
    if not isinstance(yaml, dict):
        raise WeightsError(f"expected a dict as the model's yaml, found {shown(yaml)}")
    if (channels := yaml.get("ch", 3)) != 3:
        raise WeightsError(
            f"the model reads images of {shown(channels)} channels; only models for colour images, of 3, are "
            "supported: train it on colour images"
        )
    rows = [*_rows(yaml, "backbone"), *_rows(yaml, "head")]
    if not 1 <= len(rows) <= MAX_LAYERS:
        raise WeightsError(f"expected 1 to {MAX_LAYERS} layers, found {len(rows)}")
    layers = tuple(_layer(row, index) for index, row in enumerate(rows))
    depth_multiple = _multiple(yaml, "depth_multiple")
    _check_repeats(layers, depth_multiple)
    _check_strides(layers, strides)
    return Architecture(
        depth_multiple=depth_multiple,
        width_multiple=_multiple(yaml, "width_multiple"),
        classes=classes,
        anchors_px=anchors_px,
        strides=strides,
        layers=layers,
    )


def layer_kind(name: str, where: str) -> LayerKind:
    """The kind of a module named `name`; raises WeightsError with a description of unsupported ones."""
    name = name.removeprefix("nn.")
    for kind in LAYER_KINDS:
        if kind == name:
            return kind
    why = _FOREIGN_KINDS.get(name, f"not supported; supported are {', '.join(LAYER_KINDS)}")
    raise WeightsError(f"{where} is a {shown(name)}, {why}")


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
        args=_arguments(kind, list(arguments), index),
    )
    if len(layer.sources) > {"Concat": 16, "Detect": MAX_LEVELS}.get(kind, 1):
        raise WeightsError(f"layer {index}, a {kind}, reads too many layers: {shown(layer.sources)}")
    return layer


def _arguments(kind: LayerKind, arguments: list[object], index: int) -> tuple[int, ...]:
    """`Layer.args` from a row's arguments; those of Detect come from its own attributes."""
    if kind == "Detect":
        return ()
    if not all(isinstance(argument, (str, int, float, type(None))) for argument in arguments):
        raise _unsupported(kind, arguments, index)
    if kind in _FIXED_ARGUMENTS:
        if arguments in _FIXED_ARGUMENTS[kind]:
            return ()
        raise _unsupported(kind, arguments, index)
    channels = checked_integer([*arguments, None][0], f"the channels of layer {index}", 1, MAX_CHANNELS)
    rest = arguments[1:]
    if kind == "C3" and rest in ([], [True], [False]):
        return (channels, *(int(shortcut == 1) for shortcut in rest))
    if kind == "SPPF" and len(rest) <= 1:
        window = _kernel([*rest, 5][0], index)
        if window % 2:  # an even window makes the output larger than the input
            return (channels, window)
    if kind == "Conv" and len(rest) <= 3:
        kernel, stride, *padding = rest + [1, 1][len(rest) :]
        kernel, stride = _kernel(kernel, index), checked_integer(stride, f"the stride of layer {index}", 1, 8)
        # An even kernel at stride 1 shrinks its input by one.
        if padding in ([], [None], [(kernel - 1) // 2]) and (kernel % 2 or stride > 1):
            return (channels, kernel, stride)
    raise _unsupported(kind, arguments, index)


def _kernel(value: object, index: int) -> int:
    return checked_integer(value, f"the kernel of layer {index}", 1, 15)


def _unsupported(kind: LayerKind, arguments: list[object], index: int) -> WeightsError:
    return WeightsError(f"layer {index}, a {kind}, has the arguments {shown(arguments)}: not supported")


def _check_repeats(layers: tuple[Layer, ...], depth_multiple: float) -> None:
    """Limit the bottlenecks of C3 layers and reject repeats of any other kind."""
    bottlenecks = 0
    for index, layer in enumerate(layers):
        repeats = layer.scaled_repeats(depth_multiple)
        if layer.kind == "C3":
            bottlenecks += repeats
        elif repeats > 1:
            raise WeightsError(f"layer {index}, a {layer.kind}, is repeated {repeats} times: not supported")
    if bottlenecks > MAX_BOTTLENECKS:
        raise WeightsError(f"it has {bottlenecks} bottlenecks, at most {MAX_BOTTLENECKS} are built")


def _check_strides(layers: tuple[Layer, ...], strides: tuple[int, ...]) -> None:
    """Check that concatenated inputs have equal strides and that the last layer, Detect, gets `strides`."""
    kinds = [layer.kind for layer in layers]
    if kinds.count("Detect") != 1 or kinds[-1] != "Detect":
        raise WeightsError(f"expected one Detect layer, the last, found {kinds.count('Detect')}")
    reductions: list[Fraction] = []
    for index, layer in enumerate(layers):
        inputs = [(reductions or [Fraction(1)])[source] for source in layer.sources]
        if layer.kind == "Detect":
            if inputs != list(strides):
                found = [str(reduction) for reduction in inputs]
                raise WeightsError(f"the strides are {shown(strides)}, but its layers make {shown(found)}")
        elif len(set(inputs)) > 1:
            raise WeightsError(f"layer {index}, a Concat, joins layers of different sizes")
        factor = {"Conv": Fraction(layer.args[-1] if layer.args else 1), "Upsample": Fraction(1, 2)}
        reductions.append(inputs[0] * factor.get(layer.kind, Fraction(1)))
