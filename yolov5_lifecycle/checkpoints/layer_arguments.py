"""Arguments of the layers in a model's yaml: accepted values and defaults."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from yolov5_lifecycle.models.architecture import Argument
from yolov5_lifecycle.models.model import checked_integer

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
