"""Base class of the building blocks of YOLOv5 networks, and the registry of layer kinds.

The blocks have the names and state-dict keys of checkpoints. Their constructors take the numbers
of input and output channels, with `has_repeats_inside` the number of repeats, and then the arguments of the
layer.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import ClassVar, NamedTuple, TypeVar

from torch import nn

from yolov5_lifecycle.models.cells import Cells

LAYER_KINDS: dict[str, LayerKind] = {}
"""The kinds of layers that have output channels of their own, by the names of their classes."""

_Registered = TypeVar("_Registered", bound=type[nn.Module])


class LayerKind(NamedTuple):
    """A layer class; `cells_after` maps its input cells and its arguments to its output cells."""

    block: type[nn.Module]
    cells_after: Callable[..., Cells]


def layer_kind(
    cells_after: Callable[..., Cells] = lambda cells, *_: cells,
) -> Callable[[_Registered], _Registered]:
    """Register a class as the kind of layer of its name; by default it leaves the cells as they are."""

    def register(block: _Registered) -> _Registered:
        LAYER_KINDS[block.__name__] = LayerKind(block, cells_after)
        return block

    return register


class Block(nn.Module):
    """A part of a network that can be made faster once its weights no longer change."""

    has_repeats_inside: ClassVar[bool] = False
    """Whether the repeats of a layer are an argument; otherwise the block itself is repeated."""

    def fold(self) -> None:
        """Merge what can be merged for inference, in place; up to rounding the output stays the same."""
