"""Builder of ONNX graphs with int8 convolutions."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from torch import nn

from yolov5_lifecycle.runtimes.onnx_graph_builder import Graph
from yolov5_lifecycle.runtimes.quantization import (
    Activation,
    Range,
    activation_step,
    corrected_bias,
    quantized_weight,
)


class QuantizedGraph(Graph):
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
