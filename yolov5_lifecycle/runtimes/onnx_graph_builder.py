"""Builder of ONNX graphs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper
from torch import Tensor, nn

# The oldest versions that have every operator used here; all current runtimes read them.
_OPSET = 13
_IR_VERSION = 8
INPUT = "input"
"""The name of the array that a graph reads."""


class Graph:
    """Builder of an ONNX graph that reads one array of `shape` and of an ONNX `dtype`, named INPUT.

    Values are referenced by name.
    """

    def __init__(self, shape: tuple[int, int, int, int], dtype: int) -> None:
        opset = helper.make_opsetid("", _OPSET)
        self._model = onnx.ModelProto(ir_version=_IR_VERSION, opset_import=[opset])
        self._graph = self._model.graph  # built in place, as copying large weights is slow
        self._graph.name = "yolov5"
        self._graph.input.append(helper.make_tensor_value_info(INPUT, dtype, shape))
        self._batch = shape[0]

    def add(self, operator: str, *inputs: str, **attributes: Any) -> str:
        """Add a node; return the name of its output."""
        name = f"{operator}{len(self._graph.node)}"
        self._graph.node.append(helper.make_node(operator, list(inputs), [name], **attributes))
        return name

    def constant(self, value: Tensor | NDArray[Any] | np.generic | Sequence[int]) -> str:
        """Add a constant, integers as int64; return its name."""
        array = value.detach().cpu().numpy() if isinstance(value, Tensor) else np.asarray(value)
        name = f"constant{len(self._graph.initializer)}"
        tensor = numpy_helper.from_array(np.ascontiguousarray(array).reshape(array.shape), name)
        self._graph.initializer.append(tensor)
        return name

    def factors(self, module: nn.Conv2d | nn.ConvTranspose2d, features: str) -> tuple[str, str, str]:
        """Names of the inputs of the convolution `module`: `features`, weights and bias."""
        assert module.bias is not None, "expected a fused network"
        return features, self.constant(module.weight), self.constant(module.bias)

    def serialized(self, outputs: Sequence[str]) -> bytes:
        self._graph.output.extend(
            helper.make_tensor_value_info(name, TensorProto.FLOAT, [self._batch, None, None, None])
            for name in outputs
        )
        serialized: bytes = self._model.SerializeToString()
        return serialized
