"""From the `yaml` that a YOLOv5 checkpoint carries to an Architecture."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from yolov5_lifecycle.architecture import AnchorsPx, Architecture, Layer, LayerKind
from yolov5_lifecycle.model import WeightsError

MAX_LAYERS = 200
MAX_CHANNELS = 8192
MAX_REPEATS = 100
_BEFORE_V6 = ("Focus", "BottleneckCSP", "SPP")


def architecture_of(
    yaml: object, *, classes: int, anchors_px: AnchorsPx, strides: tuple[int, ...]
) -> Architecture:
    """The rows of `backbone` and `head` and the multiples, everything checked; raises WeightsError."""
    if not isinstance(yaml, dict):
        raise WeightsError(f"the model's yaml is a {type(yaml).__name__}, not a dict")
    rows = [*_rows(yaml.get("backbone")), *_rows(yaml.get("head"))]
    if len(rows) > MAX_LAYERS:
        raise WeightsError(f"the model has {len(rows)} layers; at most {MAX_LAYERS} are read")
    layers = tuple(_layer(row, index) for index, row in enumerate(rows))
    kinds = [layer.kind for layer in layers]
    if kinds.count("Detect") != 1 or kinds[-1] != "Detect" or len(layers[-1].sources) != len(strides):
        raise WeightsError("expected one Detect layer, the last, with a source for each of its levels")
    return Architecture(
        depth_multiple=_multiple(yaml, "depth_multiple"),
        width_multiple=_multiple(yaml, "width_multiple"),
        classes=classes,
        anchors_px=anchors_px,
        strides=strides,
        layers=layers,
    )


def _rows(rows: object) -> Sequence[object]:
    if not isinstance(rows, list):
        raise WeightsError("the model's yaml has no list of backbone and head layers")
    return rows


def _multiple(yaml: dict[Any, Any], key: str) -> float:
    value = yaml.get(key)
    if not isinstance(value, (int, float)) or not math.isfinite(value) or not 0.01 <= value <= 10:
        raise WeightsError(f"{key} is {str(value)[:40]}, expected a number from 0.01 to 10")
    return float(value)


def _layer(row: object, index: int) -> Layer:
    if not isinstance(row, (list, tuple)) or len(row) != 4 or not isinstance(row[3], (list, tuple)):
        raise WeightsError(f"layer {index} is not [from, number, module, arguments]")
    sources, repeats, module, arguments = row
    kind = _kind(str(module), index)
    return Layer(
        sources=_sources(sources, index),
        repeats=_whole(repeats, f"layer {index} repeats", 1, MAX_REPEATS),
        kind=kind,
        args=_arguments(kind, list(arguments), index),
    )


def _kind(module: str, index: int) -> LayerKind:
    name = module.removeprefix("nn.").removeprefix("models.common.")
    kinds: dict[str, LayerKind] = {
        "Conv": "Conv", "C3": "C3", "SPPF": "SPPF", "Upsample": "Upsample", "Concat": "Concat", "Detect":
        "Detect"
    }  # fmt: skip
    if name in kinds:
        return kinds[name]
    if name in _BEFORE_V6:
        raise WeightsError(f"layer {index} is a {name}, of YOLOv5 before 6.0: train it again with v6 or v7")
    if name in ("Segment", "Classify"):
        raise WeightsError(f"this is a {name.lower()} model; only detection models are supported")
    raise WeightsError(
        f"layer {index} is a {name[:40]}, which is not supported; supported: {', '.join(kinds)}"
    )


def _sources(sources: object, index: int) -> tuple[int, ...]:
    """Row numbers of earlier layers; a negative one counts back and only -1 stays as it is."""
    listed = list(sources) if isinstance(sources, (list, tuple)) else [sources]
    numbers = [_whole(source, f"layer {index} input", -MAX_LAYERS, index - 1) for source in listed]
    absolute = tuple(number if number >= -1 else index + number for number in numbers)
    if not 1 <= len(absolute) <= 16 or any(number < -1 for number in absolute):
        raise WeightsError(f"layer {index} reads layers {str(listed)[:80]}, which do not exist")
    return absolute


def _arguments(kind: LayerKind, arguments: list[object], index: int) -> tuple[int, ...]:
    if kind == "Detect":
        return ()
    if (
        kind == "Upsample"
        and len(arguments) == 3
        and arguments[0] in (None, "None")
        and arguments[1:] == [2, "nearest"]
    ):
        return ()
    if kind == "Concat" and arguments == [1]:
        return ()
    if kind == "C3" and 1 <= len(arguments) <= 2:
        channels = _whole(arguments[0], f"layer {index} channels", 1, MAX_CHANNELS)
        return (channels, *(int(bool(shortcut)) for shortcut in arguments[1:]))
    if kind == "SPPF" and len(arguments) == 2 and arguments[1] in (3, 5, 7, 9, 11, 13):
        return (_whole(arguments[0], f"layer {index} channels", 1, MAX_CHANNELS), int(str(arguments[1])))
    if kind == "Conv" and 1 <= len(arguments) <= 4:
        channels, kernel, stride, *padding = [
            _whole(argument, f"layer {index} argument", 0, MAX_CHANNELS)
            for argument in [*arguments, 1, 1][: max(len(arguments), 3)]
        ]
        if 1 <= kernel <= 15 and 1 <= stride <= 8 and channels and padding in ([], [(kernel - 1) // 2]):
            return (channels, kernel, stride)
    raise WeightsError(
        f"layer {index}, a {kind}, has the arguments {str(arguments)[:80]}, which are not supported"
    )


def _whole(value: object, what: str, least: int, most: int) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or not least <= value <= most:
        raise WeightsError(f"{what}: expected a whole number from {least} to {most}, found {str(value)[:40]}")
    return value
