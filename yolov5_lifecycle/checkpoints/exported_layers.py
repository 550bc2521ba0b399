"""The layers of an exported network, from the names and shapes of its weights and from what reads what."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from yolov5_lifecycle.checkpoints.exported_blocks import (
    WITHOUT_WEIGHTS,
    Convolution,
    ExportedLayer,
    Parts,
    exported_layer,
    layer_without_weights,
)
from yolov5_lifecycle.checkpoints.graph_steps import GraphSteps, described, is_activation
from yolov5_lifecycle.checkpoints.network_steps import PIXELS, Step
from yolov5_lifecycle.checkpoints.onnx_graph import MAX_NODES, Node
from yolov5_lifecycle.checkpoints.yaml_architecture import MAX_LAYERS
from yolov5_lifecycle.models.model import WeightsError, shown

_WEIGHT = re.compile(r"(?:model\.){1,4}(\d{1,3})\.([\w.]{1,150})\.weight")
_NODE = re.compile(r"/(?:model/)*model\.(\d{1,3})/([\w./]{1,150})/Conv")
MAX_VALUES = 4_000
"""Values that are computed in a layer; 100 bottlenecks compute 700."""
Row = list[Any]
"""[sources, repeats, kind, arguments], as in a model's yaml."""


@dataclass
class ExportedLayers:
    """Rows of a yaml whose channels and repeats are those of the graph, before any multiple."""

    rows: list[Row] = field(default_factory=list)
    head: Mapping[str, Convolution] = field(default_factory=dict)
    """The convolutions of the last layer, by their paths in it."""
    image_channels: int = 3


def exported_layers(steps: GraphSteps) -> ExportedLayers:
    """The layers before the head, and the convolutions of the head. Raises WeightsError."""
    parts = _parts(steps)
    if not parts:
        raise WeightsError(
            "its weights have no names such as model.0.conv.weight, so the layers are unknown: export the "
            "model again, without an optimizer that renames them, or use the .pt"
        )
    last = max(parts)
    if last > MAX_LAYERS:
        raise WeightsError(f"expected 1 to {MAX_LAYERS} layers, found the layer {last}")
    head = parts.pop(last)
    levels = [part.reads for path, part in sorted(head.items()) if re.fullmatch(r"m\.\d", path)]
    layers = {index: exported_layer(steps, found, index) for index, found in sorted(parts.items())}
    _add_others(steps, layers, last, levels)
    found = ExportedLayers(head=head, image_channels=_image_channels(parts.get(0, {})))
    makers = {layer.made: index for index, layer in layers.items()}
    for index, layer in sorted(layers.items()):
        numbers = _sources(layer.reads, makers, index, steps)
        sources = [-1 if number == index - 1 else number for number in numbers]
        found.rows.append([sources, layer.repeats, layer.kind, layer.arguments])
    found.rows.append([_sources(tuple(levels), makers, last, steps), 1, "head", []])
    return found


def _parts(steps: GraphSteps) -> dict[int, dict[str, Convolution]]:
    """The convolutions of each layer."""
    parts: dict[int, dict[str, Convolution]] = {}
    for node in steps.graph.nodes:
        step = steps.of(node.outputs[0]) if node.outputs else Step("")
        if step.kind == "conv" and (place := _place(node)):
            index, path = place
            array = steps.graph.arrays[step.tensors[0]]
            if path in parts.setdefault(index, {}) or len(array.shape) != 4:
                raise WeightsError(f"expected one convolution named model.{index}.{path}, of four dimensions")
            parts[index][path] = Convolution(step, array.shape, _activated(steps, node.outputs[0]))
    return parts


def _place(node: Node) -> tuple[int, str] | None:
    """Layer and path in it, from the name of the weights, or of the node where torch has renamed those."""
    if named := _WEIGHT.fullmatch(node.inputs[1]):
        return int(named[1]), named[2]
    if not (named := _NODE.fullmatch(node.name)):
        return None
    path: list[str] = []
    for part in named[2].split("/"):  # such as m, then m.0
        if path and part.startswith(f"{path[-1]}."):
            path.pop()
        path.append(part)
    return int(named[1]), ".".join(path)


def _activated(steps: GraphSteps, value: str) -> str:
    """What an activation makes of `value`; `value` itself if none reads it."""
    for node in steps.graph.readers.get(value, []):
        for made in (node, *(steps.graph.readers.get(output, [None])[0] for output in node.outputs)):
            if made and made.outputs:
                step = steps.of(made.outputs[0])
                if is_activation(step) and step.inputs == (value,):
                    return made.outputs[0]
    return value


def _image_channels(first: Parts) -> int:
    """Channels of the images, which Focus makes four times as many."""
    if "conv.conv" in first:
        return first["conv.conv"].shape[1] // 4
    part = next(iter(first.values()), None)
    return part.shape[1] * part.step.settings[-1] if part else 3


def _add_others(steps: GraphSteps, layers: dict[int, ExportedLayer], last: int, levels: list[str]) -> None:
    """Add the layers without weights: they have the numbers that are left, in order of execution."""
    inside: set[str] = set()
    for layer in layers.values():
        inside.update(_between(steps, layer.reads, layer.made))
    needed = set(_between(steps, (), *levels, limit=MAX_NODES))
    order = {output: place for place, node in enumerate(steps.graph.nodes) for output in node.outputs}
    others = [
        value
        for value in sorted(needed - inside, key=lambda value: order.get(value, -1))
        if steps.of(value).kind in WITHOUT_WEIGHTS
    ]
    numbers = [index for index in range(last) if index not in layers]
    if len(numbers) != len(others):
        raise WeightsError(
            f"{len(numbers)} layers have no weights, but the graph has {len(others)} operations for them: "
            "exports of such a model are not read; use the .pt"
        )
    for index, value in zip(numbers, others, strict=True):
        layers[index] = layer_without_weights(steps.of(value), value)


def _between(
    steps: GraphSteps, first: tuple[str, ...], *values: str, limit: int = MAX_VALUES
) -> Iterator[str]:
    """`values` and what they are made of, without what `first` is made of."""
    seen, waiting = set(first), list(values)
    while waiting:
        value = waiting.pop()
        if value in seen:
            continue
        if len(seen) > limit:
            raise WeightsError(f"{shown(value)} is computed from more than {limit} values")
        seen.add(value)
        yield value
        waiting.extend(steps.of(value).inputs)


def _sources(values: tuple[str, ...], makers: Mapping[str, int], index: int, steps: GraphSteps) -> list[int]:
    """The numbers of the layers that make `values`; -1 are the pixels."""
    sources = []
    for value in values:
        is_first = index == 0 and steps.of(value).kind == PIXELS
        if not is_first and makers.get(value, index) >= index:
            raise WeightsError(
                f"layer {index} reads {shown(value)}, made by {described(steps.of(value))}, which is no "
                "layer of YOLOv5 before it: use the .pt, or export that again"
            )
        sources.append(-1 if is_first else makers[value])
    return sources
