"""ONNX export of the network without its last layer, at a fixed input shape."""

from __future__ import annotations

import numpy as np
from onnx import TensorProto

from yolov5_lifecycle.models.network import Network
from yolov5_lifecycle.runtimes.onnx_blocks import written
from yolov5_lifecycle.runtimes.onnx_graph_builder import Graph


def onnx_graph(network: Network, shape: tuple[int, int, int]) -> bytes:
    """A serialized ONNX model of a fused `network` for a number of frames, their height and their width.

    Height and width are multiples of the network's `size_multiple`. The input `planes` is uint8 (batch, c, h,
    w) in 0..255, RGB or grey as the network has it. The outputs, float32 (batch, channels, ny, nx), are the
    inputs of the network's last layer, `Detect`, which is not exported.
    """
    graph = Graph(shape, network.architecture.image_channels)
    pixels = graph.add("Cast", "planes", to=TensorProto.FLOAT)
    pixels = graph.add("Mul", pixels, graph.constant(np.float32(1 / 255)))
    *layers, detect = network.architecture.layers
    outputs: list[str] = []
    for layer, module in zip(layers, network.model[:-1], strict=True):
        inputs = [(outputs or [pixels])[source] for source in layer.sources]
        outputs.append(written(graph, module, *inputs))
    return graph.serialized([(outputs or [pixels])[source] for source in detect.sources])
