"""The rows of a model's yaml: supported modules with their arguments, and why others are refused."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

from yolov5_lifecycle.models.architecture import Argument
from yolov5_lifecycle.models.model import WeightsError, checked_integer, shown

MAX_CHANNELS = 8192
MAX_COEFFICIENTS = 256
"""Max coefficients of a mask, thus prototypes; YOLOv5's own models have 32."""
MAX_KERNEL = 15
MAX_LAYER_STRIDE = 8
_MAX_GROUPS = 8192
_MAX_WINDOWS = 8


class UnsupportedError(ValueError):
    """An argument that the layer does not support; the catcher quotes the whole row."""


@dataclass(frozen=True)
class Given:
    """An argument of a row: `read(value, where)` validates its value; `where` is for messages.

    An argument that `is_kept` is part of the layer even if it has its default value.
    """

    read: Callable[[object, str], Argument]
    default: Argument = None
    is_required: bool = False
    is_kept: bool = False


def arguments_of(row: Sequence[object], expected: Sequence[Given], where: str) -> tuple[Argument, ...]:
    """The arguments of a layer, without those at the end that have their default value.

    Raises WeightsError for a value out of its range, UnsupportedError for anything else that is wrong.
    """
    if len(row) > len(expected):
        raise UnsupportedError
    values: list[Argument] = []
    for number, given in enumerate(expected):
        if number < len(row):
            values.append(given.read(row[number], where))
        elif given.is_required:
            # A missing number is refused like a value that is not a number.
            values.append(given.read(None, where))
        else:
            values.append(given.default)
    kept = len(values)
    while kept and _is_implied(expected[kept - 1], values[kept - 1]):
        kept -= 1
    return tuple(values[:kept])


def _is_implied(given: Given, value: Argument) -> bool:
    return not given.is_required and not given.is_kept and value == given.default


def _whole(what: str, least: int, most: int) -> Callable[[object, str], int]:
    return lambda value, where: checked_integer(value, f"the {what} of {where}", least, most)


def _odd_kernel(value: object, where: str) -> int:
    """An odd kernel: with an even one, output and input would differ in size."""
    kernel = checked_integer(value, f"the kernel of {where}", 1, MAX_KERNEL)
    if kernel % 2 == 0:
        raise UnsupportedError
    return kernel


def _shortcut(value: object, where: str) -> int:
    if not isinstance(value, (bool, int)) or value not in (0, 1):
        raise UnsupportedError
    return int(value)


def _expansion(value: object, where: str) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0.01 <= value <= 4:
        raise UnsupportedError
    return float(value)


def _padding(value: object, where: str) -> int | None:
    return None if value in (None, "None") else _whole("padding", 0, MAX_KERNEL)(value, where)


def _dilation(value: object, where: str) -> int:
    # Until v6.2 the activation is here; it is read from the modules.
    return 1 if isinstance(value, (bool, str)) else _whole("dilation", 1, 8)(value, where)


def _activation(value: object, where: str) -> None:
    """Ignored: the activation is read from each module."""
    if not isinstance(value, (bool, str)) and value is not None:
        raise UnsupportedError


def _windows(value: object, where: str) -> tuple[int, ...]:
    """Window sizes that ascend."""
    if not isinstance(value, (list, tuple)) or not 1 <= len(value) <= _MAX_WINDOWS:
        raise UnsupportedError
    windows = tuple(_odd_kernel(window, where) for window in value)
    if windows != tuple(sorted(windows)):
        raise UnsupportedError
    return windows


def _sides(value: object, where: str) -> tuple[int, ...]:
    """Padding left, right, top and bottom; horizontally as much as vertically, to keep the proportions."""
    if not isinstance(value, (list, tuple)) or len(value) != 4:
        raise UnsupportedError
    sides = tuple(_whole("padding", 0, MAX_LAYER_STRIDE)(side, where) for side in value)
    if sides[0] + sides[1] != sides[2] + sides[3]:
        raise UnsupportedError
    return sides


def only(*accepted: object) -> Given:
    """An argument that must be one of `accepted` and has no effect."""

    def read(value: object, where: str) -> None:
        if isinstance(value, bool) or value not in accepted:
            raise UnsupportedError

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
