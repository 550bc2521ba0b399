"""ONNX exports by YOLOv5, read as the network that they were exported from; their graphs are never run."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from yolov5_lifecycle.checkpoints.exported_blocks import Convolution, Parts
from yolov5_lifecycle.checkpoints.exported_boxes import ExportedBoxes, exported_boxes
from yolov5_lifecycle.checkpoints.exported_layers import ExportedLayers, Row, exported_layers
from yolov5_lifecycle.checkpoints.exported_metadata import check_stride, exported_names
from yolov5_lifecycle.checkpoints.graph_steps import GraphSteps
from yolov5_lifecycle.checkpoints.matched_graph import MatchedGraph
from yolov5_lifecycle.checkpoints.network_steps import head_steps
from yolov5_lifecycle.checkpoints.onnx_graph import Graph, read_graph
from yolov5_lifecycle.checkpoints.pickled_activations import with_activations
from yolov5_lifecycle.checkpoints.yaml_architecture import architecture_of
from yolov5_lifecycle.models.architecture import SIZES, Architecture, Layer
from yolov5_lifecycle.models.model import (
    Model,
    WeightsError,
    blueprint,
    check_class_names,
    check_fit,
    checked_model,
)

_UNSCALED = {"depth_multiple": 1, "width_multiple": 1, "channel_multiple": 1}


def read_onnx(data: bytes) -> Model:
    """The model in the bytes of an export by YOLOv5's `export.py`; raises WeightsError.

    It is accepted only if its graph computes features, prototypes and boxes in the same steps as the network.
    """
    graph = read_graph(data)
    _check_exporter(graph)
    steps = GraphSteps(graph)
    layers = exported_layers(steps)
    head = {path: part for path, part in layers.head.items() if re.fullmatch(r"m\.\d", path)}
    levels = [part.made for _, part in sorted(head.items())]
    boxes = exported_boxes(graph, levels)
    check_stride(graph.metadata, boxes.strides)
    names = check_class_names(exported_names(graph.metadata, boxes.classes), boxes.classes)
    architecture = _architecture(layers, boxes)
    matched = _matched(architecture, steps, layers.head, levels)
    architecture = with_activations(architecture, matched.activations)
    tensors = _tensors(matched.arrays, graph, architecture, len(data))
    return checked_model(_official(architecture), names, tensors)


def _check_exporter(graph: Graph) -> None:
    if "task" in graph.metadata and "imgsz" in graph.metadata:
        raise WeightsError(
            "this export belongs to the ultralytics package (YOLOv8 or later, or a YOLOv5 'u' model); "
            "expected one by YOLOv5's own export.py"
        )


def _architecture(layers: ExportedLayers, boxes: ExportedBoxes) -> Architecture:
    """The architecture with the channels and repeats of the graph, and multiples of 1."""
    *body, (sources, repeats, _, _) = layers.rows
    last: Row = [sources, repeats, "Detect", []]
    if boxes.coefficients:
        prototypes = _prototypes(layers.head)
        arguments = ["nc", "anchors", boxes.coefficients, prototypes["cv1"].channels_out]
        last = [sources, repeats, "Segment", arguments]
    architecture = architecture_of(
        _UNSCALED | {"backbone": [*body, last], "head": []},
        classes=boxes.classes,
        anchors_px=boxes.anchors_px,
        strides=boxes.strides,
        image_channels=layers.image_channels,
    )
    return replace(architecture, is_fused=True)


def _prototypes(head: Mapping[str, Convolution]) -> dict[str, Convolution]:
    found = {number: head.get(f"proto.{number}.conv") for number in ("cv1", "cv2", "cv3")}
    if not all(found.values()):
        raise WeightsError(
            "its predictions have coefficients of masks, but there are no prototypes: use the .pt"
        )
    return {number: part for number, part in found.items() if part is not None}


def _matched(architecture: Architecture, steps: GraphSteps, head: Parts, levels: list[str]) -> MatchedGraph:
    """The graph as that of `architecture`, compared with it from the head up to the pixels."""
    expected, prototypes = head_steps(blueprint(architecture))
    matched = MatchedGraph(steps)
    for step, value in zip(expected, levels, strict=True):
        matched.compare(step, value)
    if prototypes is not None:
        made = _prototypes(head)["cv3"].made
        matched.compare(prototypes, made)
        if made not in steps.graph.outputs:
            raise WeightsError("the prototypes of masks are no output of the graph: use the .pt")
    return matched


def _tensors(
    arrays: Mapping[str, str], graph: Graph, architecture: Architecture, file_bytes: int
) -> dict[str, Tensor]:
    """The tensors of the network; those with equal numbers may share an array of the file."""
    stored = {key: graph.arrays[name] for key, name in arrays.items()}
    total_bytes = sum(len(array.content) for array in stored.values())
    if total_bytes > 2 * file_bytes:
        raise WeightsError(f"its weights claim {total_bytes} bytes, but the file has {file_bytes}")
    blank = blueprint(architecture).state_dict()
    anchors = f"model.{len(architecture.layers) - 1}.anchors"
    made = {key: tensor for key, tensor in blank.items() if key.endswith("num_batches_tracked")}
    claimed = {key: array.on_meta() for key, array in stored.items()}
    check_fit(blank, claimed | made | {anchors: blank[anchors]})
    tensors = {key: torch.from_numpy(array.numbers()) for key, array in stored.items()}
    strides = torch.tensor(architecture.strides).view(-1, 1, 1)
    counters = {key: torch.zeros(tensor.shape, dtype=tensor.dtype) for key, tensor in made.items()}
    return tensors | counters | {anchors: torch.tensor(architecture.anchors_px) / strides}


def _official(architecture: Architecture) -> Architecture:
    """`architecture` with the multiples of the official size that has the same layers, if there is one."""
    for size in SIZES.values():
        head = architecture.layers[-1].kind
        layers = size.layers
        if head == "Segment":
            coefficients = architecture.mask_coefficients
            layers = (*layers[:-1], layers[-1]._replace(kind="Segment", args=(coefficients, 256)))
        candidate = replace(
            architecture,
            layers=layers,
            depth_multiple=size.depth_multiple,
            width_multiple=size.width_multiple,
            channel_multiple=size.channel_multiple,
        )
        if _scaled(candidate) == _scaled(architecture):
            return candidate
    return architecture


def _scaled(architecture: Architecture) -> list[Any]:
    """The layers with the numbers of channels and repeats that they are built with."""
    return [_scaled_layer(layer, architecture) for layer in architecture.layers] + [
        architecture.prototype_channels if architecture.mask_coefficients else 0
    ]


def _scaled_layer(layer: Layer, architecture: Architecture) -> Layer:
    args = layer.args
    if layer.kind in ("Conv", "C3", "SPPF") and isinstance(args[0], int):
        args = (architecture.scaled_channels(args[0]), *map(_plain, args[1:]))
    if layer.kind == "Segment":
        args = args[:1]
    return layer._replace(args=args, repeats=layer.scaled_repeats(architecture.depth_multiple))


def _plain(argument: Any) -> Any:
    return int(argument) if isinstance(argument, bool) else argument
