"""The rows of a model's yaml: supported modules with their arguments, and why others are refused."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType

from yolov5_lifecycle.checkpoints.layer_arguments import (
    ACTIVATION,
    CHANNELS,
    COEFFICIENTS,
    DILATION,
    EXPANSION,
    GAIN,
    GROUPS,
    KERNEL,
    NO_PADDING,
    ODD_KERNEL,
    PADDING,
    PROTOTYPE_CHANNELS,
    SHORTCUT,
    SIDES,
    STRIDE,
    WINDOWS,
    Given,
    UnsupportedError,
    arguments_of,
    only,
)
from yolov5_lifecycle.models.architecture import Argument
from yolov5_lifecycle.models.model import WeightsError, shown

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
        "CrossCSP": _PARTIAL,
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
        arguments = arguments_of(row, ROWS[kind], where)
        return _padded(arguments) if kind == "Conv" else arguments
    except UnsupportedError:
        raise WeightsError(f"{where}, a {kind}, has the arguments {shown(row)}: not supported") from None


def _padded(arguments: tuple[Argument, ...]) -> tuple[Argument, ...]:
    """The arguments of Conv, with the padding of YOLOv5 where it is not that of our Conv."""
    _, kernel, stride = arguments[:3]
    padding = arguments[3] if len(arguments) > 3 else None
    dilation = arguments[5] if len(arguments) > 5 else 1
    assert isinstance(kernel, int)
    assert isinstance(dilation, int)
    if kernel % 2 == 0 and stride == 1:  # the output has another size than the input
        raise UnsupportedError
    wanted = (dilation * (kernel - 1) + 1) // 2 if padding is None else padding
    if wanted != dilation * (kernel - 1) // 2:
        return (*arguments[:3], wanted, *arguments[4:])
    return (*arguments[:3], None, *arguments[4:]) if arguments[4:] else arguments[:3]
