"""Sizes of the feature maps of an architecture."""

from __future__ import annotations

import math

from yolov5_lifecycle.models.architecture import Architecture, Layer
from yolov5_lifecycle.models.blocks import LAYER_KINDS
from yolov5_lifecycle.models.cells import Cells
from yolov5_lifecycle.models.network import has_repeats_inside
from yolov5_lifecycle.models.resizing import RESIZING


def cells_of_layers(architecture: Architecture) -> list[Cells]:
    """The cells of each layer, for the head those of its first input.

    Raises ValueError if a layer joins feature maps of different sizes.
    """
    found: list[Cells] = []
    for index, layer in enumerate(architecture.layers):
        inputs = [(found or [Cells()])[source] for source in layer.sources]
        if layer.kind == "Concat" and len(set(inputs)) > 1:
            raise ValueError(f"layer {index}, a Concat, joins layers of different sizes")
        try:
            found.append(_cells_after(layer, inputs[0], architecture.depth_multiple))
        except ValueError as error:
            raise ValueError(f"layer {index}, a {layer.kind}: {error}") from None
    return found


def size_multiple(architecture: Architecture) -> int:
    """The number of which input height and width must be multiples for all layers to fit each other.

    It is the largest stride; that of a layer may be larger than those of the detection levels.
    """
    return math.lcm(*(cells.pixels.numerator for cells in cells_of_layers(architecture)))


def _cells_after(layer: Layer, cells: Cells, depth_multiple: float) -> Cells:
    if layer.kind in RESIZING:
        return RESIZING[layer.kind].cells_after(cells, *layer.args)
    if layer.kind not in LAYER_KINDS:
        return cells
    repeats = 1 if has_repeats_inside(layer.kind) else layer.scaled_repeats(depth_multiple)
    for _ in range(repeats):
        cells = LAYER_KINDS[layer.kind].cells_after(cells, *layer.args[1:])
    return cells
