"""ONNX graphs, at a fixed input shape, of the parts of a network that engines run.

They are recorded: a fused network's own code runs on tensors that have a shape and a name in the graph.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, cast

import numpy as np
import onnx
import torch
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper
from torch import Tensor, nn
from torch.nn import functional

from yolov5_lifecycle.models.head import PARITIES, Proto
from yolov5_lifecycle.models.network import Network
from yolov5_lifecycle.models.shape_tensor import CostCounter, ShapeTensor
from yolov5_lifecycle.runtimes.processor import abilities, weight_bits
from yolov5_lifecycle.runtimes.quantization import (
    Activation,
    Quantization,
    Range,
    activation_step,
    corrected_bias,
    quantized_weight,
)

# The oldest versions that have every operator used here; all current runtimes read them.
_OPSET = 13
_IR_VERSION = 8
INPUT = "input"
"""The name of the array that a graph reads."""


def onnx_graph(network: Network, shape: tuple[int, int], quantization: Quantization | None = None) -> bytes:
    """A serialized ONNX model of a fused `network` for frames of `shape`, their height and width.

    Height and width are multiples of the network's `size_multiple`. The input is uint8 (1, c, h, w) in
    0..255, RGB or grey as the network has it. The outputs, float32 (1, channels, ny, nx), are the inputs
    of the network's last layer, which is not exported. With `quantization` convolutions read and multiply
    integers; it must fit the network, see `Quantization.check`.
    """
    planes = (1, network.architecture.image_channels, *shape)
    graph = Graph(planes, TensorProto.UINT8)
    if quantization is not None:
        graph.activations = quantization.of_weights(network)
    as_float = graph.add("Cast", INPUT, to=TensorProto.FLOAT)
    pixels = graph.tensor(planes, graph.add("Mul", as_float, graph.constant(np.float32(1 / 255))))
    features = network.features(cast(Tensor, pixels))
    return graph.serialized(cast(list[GraphTensor], features))


def prototype_graph(proto: Proto, shape: tuple[int, int, int, int]) -> bytes:
    """A serialized ONNX model of the fused `proto` for features of `shape`, (1, channels, ny, nx) in float32.

    The output is the prototypes, float32 (1, M, 2 ny, 2 nx).
    """
    assert proto.quarters is not None, "expected a fused network"
    graph = Graph(shape, TensorProto.FLOAT)
    widened = proto.cv1(graph.tensor(shape, INPUT))
    quarters = []
    for convolution, (row, column) in zip(proto.quarters, PARITIES, strict=True):
        assert isinstance(convolution, nn.Conv2d)
        pads = [1 - row, 1 - column, row, column]
        factors = graph.factors(widened, convolution.weight, convolution.bias)
        name = graph.add("Conv", *factors, kernel_shape=[2, 2], pads=pads)
        quarters.append(proto.cv3(proto.cv2.act(graph.tensor(widened.shape, name))))
    joined = cast(GraphTensor, torch.cat(quarters, dim=1))
    shuffled = graph.add("DepthToSpace", joined.name, blocksize=2, mode="DCR")
    return graph.serialized([graph.tensor(joined.shape, shuffled)])


class Graph:
    """Builder of an ONNX graph that reads one array of `shape` and of an ONNX `dtype`, named INPUT.

    Values are referenced by name. Convolutions with weights that have `activations` are quantized, their
    inputs and their weights. Only these are: OpenVINO moves the rounding of an input to where it is computed,
    and computes activations and concatenations between two convolutions in the registers of the first.
    """

    def __init__(self, shape: tuple[int, ...], dtype: int) -> None:
        opset = helper.make_opsetid("", _OPSET)
        self._model = onnx.ModelProto(ir_version=_IR_VERSION, opset_import=[opset])
        self._graph = self._model.graph  # built in place, as copying large weights is slow
        self._graph.name = "yolov5"
        self._graph.input.append(helper.make_tensor_value_info(INPUT, dtype, shape))
        self.activations: Mapping[Tensor, Activation] = {}
        self._rounded: dict[tuple[str, Range], str] = {}

    def tensor(self, shape: tuple[int, ...], name: str) -> GraphTensor:
        """A value of the graph, float32, for a network's code to run on."""
        return GraphTensor(shape, CostCounter(layer="a layer"), graph=self, name=name)

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

    def factors(self, features: GraphTensor, weight: Tensor, bias: Tensor | None) -> tuple[str, str, str]:
        """Names of the inputs of a convolution: `features`, `weight` and `bias`."""
        assert bias is not None, "expected a fused network"
        read = self.activations.get(weight)
        if read is None:
            return features.name, self.constant(weight), self.constant(bias)
        exact = weight.detach().numpy()
        integers, steps = quantized_weight(exact, weight_bits(abilities()))
        rounded = integers * steps.reshape(-1, 1, 1, 1)
        parts = [self.constant(part) for part in (integers, steps, np.zeros(len(steps), np.int8))]
        return (
            self._activation(features.name, read.range),
            self.add("DequantizeLinear", *parts, axis=0),
            self.constant(corrected_bias(exact, bias.detach().numpy(), rounded, read.means)),
        )

    def _activation(self, features: str, range_: Range) -> str:
        if (features, range_) not in self._rounded:
            step, zero = (self.constant(part) for part in activation_step(range_))
            integers = self.add("QuantizeLinear", features, step, zero)
            self._rounded[features, range_] = self.add("DequantizeLinear", integers, step, zero)
        return self._rounded[features, range_]

    def serialized(self, outputs: Sequence[GraphTensor]) -> bytes:
        self._graph.output.extend(
            helper.make_tensor_value_info(output.name, TensorProto.FLOAT, output.shape) for output in outputs
        )
        serialized: bytes = self._model.SerializeToString()
        return serialized


class GraphTensor(ShapeTensor):
    """A value of `graph`: an operation on it adds the nodes that compute the result.

    Those without an entry in `_WRITERS`, which no fused network uses, raise NotImplementedError.
    """

    def __init__(
        self,
        shape: tuple[int, ...],
        counter: CostCounter,
        of: ShapeTensor | None = None,
        *,
        graph: Graph,
        name: str = "",
    ) -> None:
        super().__init__(shape, counter, of)
        self.graph = graph
        self.name = name

    @classmethod
    def called(cls, function: Callable[..., object], *args: Any, **kwargs: Any) -> object:
        """The result of the `function` of torch, which adds a node to the graph."""
        if function not in _WRITERS:
            raise NotImplementedError(f"{function} of {cls.__name__}")
        graph = (args[0] if isinstance(args[0], GraphTensor) else args[0][0]).graph
        name = _WRITERS[function](graph, *args, **kwargs)
        result = super().called(function, *args, **kwargs)
        made = result[0] if isinstance(result, tuple) else result
        cast(GraphTensor, made).name = name
        return result

    def made(self, *shape: int, of: ShapeTensor | None = None) -> GraphTensor:
        return GraphTensor(shape, self.counter, of, graph=self.graph)

    def __add__(self, other: ShapeTensor) -> GraphTensor:
        assert isinstance(other, GraphTensor)
        name = self.graph.add("Add", self.name, other.name)
        return self.graph.tensor(super().__add__(other).shape, name)

    def permute(self, *order: int) -> GraphTensor:
        name = self.graph.add("Transpose", self.name, perm=order)
        return self.graph.tensor(super().permute(*order).shape, name)

    def reshape(self, *sizes: Any) -> GraphTensor:
        shape = super().reshape(*sizes).shape
        return self.graph.tensor(shape, self.graph.add("Reshape", self.name, self.graph.constant(shape)))


def _convolved(
    graph: Graph, features: GraphTensor, weight: Tensor, bias: Tensor | None, *window: Any, **attributes: Any
) -> str:
    """`window`: stride, padding, dilation and groups."""
    stride, padding, dilation, groups = window
    return graph.add(
        "ConvTranspose" if attributes else "Conv",
        *graph.factors(features, weight, bias),
        kernel_shape=weight.shape[2:],
        strides=stride,
        pads=[*padding, *padding],
        dilations=dilation,
        group=groups,
        **attributes,
    )


def _transposed(
    graph: Graph, features: GraphTensor, weight: Tensor, bias: Tensor | None, *window: Any
) -> str:
    """`window`: stride, padding, output padding, groups and dilation."""
    stride, padding, more, groups, dilation = window
    return _convolved(graph, features, weight, bias, stride, padding, dilation, groups, output_padding=more)


def _pooled(
    graph: Graph, features: GraphTensor, kernel: int, stride: int, padding: int = 0, *_: object, **__: object
) -> str:
    return graph.add(
        "MaxPool", features.name, kernel_shape=[kernel] * 2, strides=[stride] * 2, pads=[padding] * 4
    )


def _resized(graph: Graph, features: GraphTensor, *, scale_factor: float, **_: object) -> str:
    # With `asymmetric` and `floor`, nearest repeats pixels, as in torch.
    return graph.add(
        "Resize",
        features.name,
        "",
        graph.constant(np.array([1, 1, scale_factor, scale_factor], np.float32)),
        coordinate_transformation_mode="asymmetric",
        mode="nearest",
        nearest_mode="floor",
    )


def _padded(graph: Graph, features: GraphTensor, pad: Sequence[int], *_: object, **__: object) -> str:
    left, right, top, bottom = pad
    return graph.add("Pad", features.name, graph.constant([0, 0, top, left, 0, 0, bottom, right]))


def _linear(graph: Graph, cells: GraphTensor, weight: Tensor, bias: Tensor | None = None) -> str:
    return _product(graph, cells.name, weight, bias)


def _product(graph: Graph, cells: str, weight: Tensor, bias: Tensor | None) -> str:
    product = graph.add("MatMul", cells, graph.constant(weight.T))
    return product if bias is None else graph.add("Add", product, graph.constant(bias))


def _attended(
    graph: Graph,
    queries: GraphTensor,
    keys: GraphTensor,
    values: GraphTensor,
    channels: int,
    heads: int,
    weight: Tensor,
    bias: Tensor,
    *others: Any,
    **__: object,
) -> str:
    """Attention of every cell to every cell, (cells, 1, channels) each, in parts of the channels."""
    *_, out_weight, out_bias = others
    by_head = graph.constant([-1, heads, channels // heads])
    query, key, value = (
        graph.add("Reshape", _product(graph, read.name, *factors), by_head)
        for read, *factors in zip((queries, keys, values), weight.chunk(3), bias.chunk(3), strict=True)
    )
    query = graph.add("Mul", query, graph.constant(np.float32(1 / math.sqrt(channels // heads))))
    query, value = (graph.add("Transpose", part, perm=[1, 0, 2]) for part in (query, value))
    products = graph.add("MatMul", query, graph.add("Transpose", key, perm=[1, 2, 0]))
    mixed = graph.add("MatMul", graph.add("Softmax", products, axis=-1), value)
    joined = graph.add(
        "Reshape", graph.add("Transpose", mixed, perm=[1, 0, 2]), graph.constant([-1, 1, channels])
    )
    return _product(graph, joined, out_weight, out_bias)


_WRITERS: Mapping[Callable[..., object], Callable[..., str]] = {
    torch.conv2d: _convolved,
    torch.conv_transpose2d: _transposed,
    **dict.fromkeys((torch.max_pool2d, functional.max_pool2d), _pooled),
    functional.interpolate: _resized,
    functional.pad: _padded,
    torch.cat: lambda graph, parts, dim: graph.add("Concat", *(part.name for part in parts), axis=dim),
    functional.silu: lambda graph, features, **_: graph.add(
        "Mul", features.name, graph.add("Sigmoid", features.name)
    ),
    functional.hardswish: lambda graph, features, **_: graph.add(
        "Mul", features.name, graph.add("HardSigmoid", features.name, alpha=1 / 6, beta=0.5)
    ),
    functional.leaky_relu: lambda graph, features, negative_slope, **_: graph.add(
        "LeakyRelu", features.name, alpha=negative_slope
    ),
    functional.relu: lambda graph, features, **_: graph.add("Relu", features.name),
    functional.linear: _linear,
    functional.multi_head_attention_forward: _attended,
}
