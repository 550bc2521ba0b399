"""ONNX export, at a fixed input shape, of the parts of a network that engines run."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from onnx import TensorProto
from torch import nn

from yolov5_lifecycle.models.head import Proto
from yolov5_lifecycle.models.network import Network
from yolov5_lifecycle.runtimes.onnx_blocks import written
from yolov5_lifecycle.runtimes.onnx_graph_builder import INPUT, Graph
from yolov5_lifecycle.runtimes.quantization import (
    Activation,
    Quantization,
    Range,
    activation_step,
    corrected_bias,
    quantized_weight,
)


def onnx_graph(network: Network, shape: tuple[int, int], quantization: Quantization | None = None) -> bytes:
    """A serialized ONNX model of a fused `network` for frames of `shape`, their height and width.

    Height and width are multiples of the network's `size_multiple`. The input is uint8 (1, c, h, w) in
    0..255, RGB or grey as the network has it. The outputs, float32 (1, channels, ny, nx), are the inputs
    of the network's last layer, which is not exported. With `quantization` convolutions read and multiply
    integers; it must fit the network, see `Quantization.check`.
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
    return _QuantizedGraph(planes, TensorProto.UINT8, activations, weight_bits=quantization.weight_bits)


def prototype_graph(proto: Proto, shape: tuple[int, int, int, int]) -> bytes:
    """A serialized ONNX model of the fused `proto` for features of `shape`, (1, channels, ny, nx) in float32.

    The output is the prototypes, float32 (1, M, 2 ny, 2 nx).
    """
    graph = Graph(shape, TensorProto.FLOAT)
    return graph.serialized([written(graph, proto, INPUT)])


class _QuantizedGraph(Graph):
    """Quantizes the inputs of the convolutions in `activations`, and their weights to `weight_bits`.

    Only these are quantized: OpenVINO moves the rounding of an input to where it is computed, and
    computes activations and concatenations between two convolutions in the registers of the first.
    """

    def __init__(
        self,
        shape: tuple[int, int, int, int],
        dtype: int,
        activations: Mapping[nn.Module, Activation],
        *,
        weight_bits: int,
    ) -> None:
        super().__init__(shape, dtype)
        self._activations = activations
        self._weight_bits = weight_bits
        self._rounded: dict[tuple[str, Range], str] = {}

    def factors(self, module: nn.Conv2d | nn.ConvTranspose2d, features: str) -> tuple[str, str, str]:
        """See `Graph`."""
        read = self._activations.get(module)
        if read is None:
            return super().factors(module, features)
        assert isinstance(module, nn.Conv2d)
        integers, steps = quantized_weight(module.weight.detach().numpy(), self._weight_bits)
        bias = corrected_bias(module, integers * steps.reshape(-1, 1, 1, 1), read.means)
        parts = [self.constant(part) for part in (integers, steps, np.zeros(len(steps), np.int8))]
        weight = self.add("DequantizeLinear", *parts, axis=0)
        return self._activation(features, read.range), weight, self.constant(bias)

    def _activation(self, features: str, range_: Range) -> str:
        if (features, range_) not in self._rounded:
            step, zero = (self.constant(part) for part in activation_step(range_))
            integers = self.add("QuantizeLinear", features, step, zero)
            self._rounded[features, range_] = self.add("DequantizeLinear", integers, step, zero)
        return self._rounded[features, range_]
