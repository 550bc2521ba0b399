"""ONNX export, at a fixed input shape, of the parts of a network that engines run."""

from __future__ import annotations

import numpy as np
from onnx import TensorProto

from yolov5_lifecycle.models.head import Proto
from yolov5_lifecycle.models.network import Network
from yolov5_lifecycle.runtimes.onnx_blocks import written
from yolov5_lifecycle.runtimes.onnx_graph_builder import INPUT, Graph
from yolov5_lifecycle.runtimes.onnx_quantized import QuantizedGraph
from yolov5_lifecycle.runtimes.quantization import Quantization


def onnx_graph(network: Network, shape: tuple[int, int], quantization: Quantization | None = None) -> bytes:
    """A serialized ONNX model of a fused `network` for frames of `shape`, their height and width.

    Height and width are multiples of the network's `size_multiple`. The input is uint8 (1, c, h, w) in
    0..255, RGB or grey as the network has it. The outputs, float32 (1, channels, ny, nx), are the inputs
    of the network's last layer, which is not exported. With `quantization` convolutions read and multiply
    integers; raises QuantizationError if it does not fit the network.
    """
    graph = _graph(network, shape, quantization)
    pixels = graph.add("Cast", INPUT, to=TensorProto.FLOAT)
    pixels = graph.add("Mul", pixels, graph.constant(np.float32(1 / 255)))
    *layers, head = network.architecture.layers
    outputs: list[str] = []
    for layer, module in zip(layers, network.model[:-1], strict=True):
        inputs = [(outputs or [pixels])[source] for source in layer.sources]
        outputs.append(written(graph, module, *inputs))
    return graph.serialized([(outputs or [pixels])[source] for source in head.sources])


def _graph(network: Network, shape: tuple[int, int], quantization: Quantization | None) -> Graph:
    planes = (1, network.architecture.image_channels, *shape)
    if quantization is None:
        return Graph(planes, TensorProto.UINT8)
    activations = quantization.of_modules(network)
    return QuantizedGraph(planes, TensorProto.UINT8, activations, weight_bits=quantization.weight_bits)


def prototype_graph(proto: Proto, shape: tuple[int, int, int, int]) -> bytes:
    """A serialized ONNX model of the fused `proto` for features of `shape`, (1, channels, ny, nx) in float32.

    The output is the prototypes, float32 (1, M, 2 ny, 2 nx).
    """
    graph = Graph(shape, TensorProto.FLOAT)
    return graph.serialized([written(graph, proto, INPUT)])
