"""ONNX graphs, at a fixed input shape, of the parts of a network that engines run."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, TypeVar

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper
from torch import Tensor, nn

from yolov5_lifecycle.models.blocks import (
    SPP,
    SPPF,
    Contract,
    Expand,
    GhostBottleneck,
    GhostConv,
    NormalisedPartial,
    Partial,
    Shortcut,
    TransformerBlock,
    TransformerLayer,
)
from yolov5_lifecycle.models.convolutions import Conv, Focus, MixConv2d
from yolov5_lifecycle.models.head import PARITIES, Proto
from yolov5_lifecycle.models.network import Concat, Network
from yolov5_lifecycle.runtimes.quantization import (
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

Writer = Callable[..., str]
"""Adds the nodes of a module for its named inputs; returns the name of its output."""
_WRITERS: dict[type[nn.Module], Writer] = {}
_Written = TypeVar("_Written", bound=Writer)


def onnx_graph(network: Network, shape: tuple[int, int], quantization: Quantization | None = None) -> bytes:
    """A serialized ONNX model of a fused `network` for frames of `shape`, their height and width.

    Height and width are multiples of the network's `size_multiple`. The input is uint8 (1, c, h, w) in
    0..255, RGB or grey as the network has it. The outputs, float32 (1, channels, ny, nx), are the inputs
    of the network's last layer, which is not exported. With `quantization` convolutions read and multiply
    integers; it must fit the network, see `Quantization.check`.
    """
    planes = (1, network.architecture.image_channels, *shape)
    graph = (
        Graph(planes, TensorProto.UINT8)
        if quantization is None
        else _QuantizedGraph(planes, network, quantization)
    )
    pixels = graph.add("Cast", INPUT, to=TensorProto.FLOAT)
    pixels = graph.add("Mul", pixels, graph.constant(np.float32(1 / 255)))
    *layers, head = network.architecture.layers
    outputs: list[str] = []
    for layer, module in zip(layers, network.model[:-1], strict=True):
        inputs = [(outputs or [pixels])[source] for source in layer.sources]
        outputs.append(written(graph, module, *inputs))
    return graph.serialized([(outputs or [pixels])[source] for source in head.sources])


def prototype_graph(proto: Proto, shape: tuple[int, int, int, int]) -> bytes:
    """A serialized ONNX model of the fused `proto` for features of `shape`, (1, channels, ny, nx) in float32.

    The output is the prototypes, float32 (1, M, 2 ny, 2 nx).
    """
    graph = Graph(shape, TensorProto.FLOAT)
    return graph.serialized([written(graph, proto, INPUT)])


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


class _QuantizedGraph(Graph):
    """Quantizes weights and inputs of convolutions, for frames in uint8, as `quantization` says.

    Only these are quantized: OpenVINO moves the rounding of an input to where it is computed, and
    computes activations and concatenations between two convolutions in the registers of the first.
    """

    def __init__(
        self, shape: tuple[int, int, int, int], network: Network, quantization: Quantization
    ) -> None:
        super().__init__(shape, TensorProto.UINT8)
        self._activations = quantization.of_modules(network)
        self._weight_bits = quantization.weight_bits
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


def written(graph: Graph, module: nn.Module, *inputs: str) -> str:
    """Add `module` to `graph`; return the name of its output. Raises TypeError for an unknown class."""
    for kind in type(module).__mro__:
        if kind in _WRITERS:
            return _WRITERS[kind](graph, module, *inputs)
    raise TypeError(f"Expected a block of a network, found {type(module).__name__}.")


def _writes(*kinds: type[nn.Module]) -> Callable[[_Written], _Written]:
    """Register a function as the writer of modules of `kinds` and of classes derived from them."""

    def register(writer: _Written) -> _Written:
        _WRITERS.update(dict.fromkeys(kinds, writer))
        return writer

    return register


@_writes(Conv)
def _conv(graph: Graph, module: Conv, features: str) -> str:
    return written(graph, module.act, written(graph, module.conv, features))


@_writes(nn.Conv2d)
def _convolution(graph: Graph, module: nn.Conv2d, features: str) -> str:
    return _weighted(graph, "Conv", module, features, dilations=list(module.dilation))


@_writes(nn.ConvTranspose2d)
def _transposed(graph: Graph, module: nn.ConvTranspose2d, features: str) -> str:
    return _weighted(graph, "ConvTranspose", module, features, output_padding=list(module.output_padding))


def _weighted(
    graph: Graph,
    operator: str,
    module: nn.Conv2d | nn.ConvTranspose2d,
    features: str,
    **attributes: list[int],
) -> str:
    usual = {"pads": [int(pad) for pad in module.padding] * 2}
    return graph.add(
        operator,
        *graph.factors(module, features),
        kernel_shape=list(module.kernel_size),
        strides=list(module.stride),
        group=module.groups,
        **(usual | attributes),
    )


@_writes(nn.Sequential)
def _sequential(graph: Graph, module: nn.Sequential, features: str) -> str:
    for part in module:
        features = written(graph, part, features)
    return features


@_writes(Shortcut)
def _shortcut(graph: Graph, module: Shortcut, features: str) -> str:
    refined = written(graph, module.cv2, written(graph, module.cv1, features))
    return graph.add("Add", features, refined) if module.add else refined


@_writes(GhostConv)
def _ghost(graph: Graph, module: GhostConv, features: str) -> str:
    primary = written(graph, module.cv1, features)
    return graph.add("Concat", primary, written(graph, module.cv2, primary), axis=1)


@_writes(GhostBottleneck)
def _ghost_bottleneck(graph: Graph, module: GhostBottleneck, features: str) -> str:
    refined = written(graph, module.conv, features)
    return graph.add("Add", refined, written(graph, module.shortcut, features))


@_writes(MixConv2d)
def _mixed(graph: Graph, module: MixConv2d, features: str) -> str:
    parts = [written(graph, convolution, features) for convolution in module.m]
    return written(graph, module.act, graph.add("Concat", *parts, axis=1))


@_writes(Partial)
def _partial(graph: Graph, module: Partial, features: str) -> str:
    refined = written(graph, module.m, written(graph, module.cv1, features))
    bypass = written(graph, module.cv2, features)
    return written(graph, module.cv3, graph.add("Concat", refined, bypass, axis=1))


@_writes(NormalisedPartial)
def _normalised_partial(graph: Graph, module: NormalisedPartial, features: str) -> str:
    refined = written(graph, module.cv3, written(graph, module.m, written(graph, module.cv1, features)))
    joined = graph.add("Concat", refined, written(graph, module.cv2, features), axis=1)
    return written(graph, module.cv4, written(graph, module.act, joined))


@_writes(SPPF)
def _sppf(graph: Graph, module: SPPF, features: str) -> str:
    kernel = module.m.kernel_size
    assert isinstance(kernel, int)
    return _pyramid(graph, module, (kernel,) * 3, features)


@_writes(SPP)
def _spp(graph: Graph, module: SPP, features: str) -> str:
    return _pyramid(graph, module, module.steps, features)


def _pyramid(graph: Graph, module: SPP | SPPF, steps: tuple[int, ...], features: str) -> str:
    pool = partial(_pooled, graph, stride=1)
    windows = itertools.accumulate(
        steps,
        lambda window, step: pool(window, kernel=step, padding=step // 2),
        initial=written(graph, module.cv1, features),
    )
    return written(graph, module.cv2, graph.add("Concat", *windows, axis=1))


def _pooled(graph: Graph, features: str, *, kernel: int, stride: int, padding: int) -> str:
    return graph.add("MaxPool", features, kernel_shape=[kernel] * 2, strides=[stride] * 2, pads=[padding] * 4)


@_writes(nn.MaxPool2d)
def _max_pool(graph: Graph, module: Any, features: str) -> str:
    kernel, stride, padding = module.kernel_size, module.stride, module.padding
    return _pooled(graph, features, kernel=kernel, stride=stride, padding=padding)


@_writes(nn.ZeroPad2d)
def _padded(graph: Graph, module: nn.ZeroPad2d, features: str) -> str:
    left, right, top, bottom = module.padding
    return graph.add("Pad", features, graph.constant([0, 0, top, left, 0, 0, bottom, right]))


@_writes(nn.Upsample)
def _upsampled(graph: Graph, module: nn.Upsample, features: str) -> str:
    # With `asymmetric` and `floor`, nearest repeats pixels, as in torch.
    return graph.add(
        "Resize",
        features,
        "",
        graph.constant(np.array([1, 1, 2, 2], np.float32)),
        coordinate_transformation_mode="asymmetric",
        mode="nearest",
        nearest_mode="floor",
    )


@_writes(Proto)
def _prototypes(graph: Graph, module: Proto, features: str) -> str:
    assert module.quarters is not None, "expected a fused network"
    widened = written(graph, module.cv1, features)
    quarters = []
    for convolution, (row, column) in zip(module.quarters, PARITIES, strict=True):
        assert isinstance(convolution, nn.Conv2d)
        pads = [1 - row, 1 - column, row, column]
        quarter = _weighted(graph, "Conv", convolution, widened, pads=pads)
        quarters.append(written(graph, module.cv3, written(graph, module.cv2.act, quarter)))
    return graph.add("DepthToSpace", graph.add("Concat", *quarters, axis=1), blocksize=2, mode="DCR")


@_writes(TransformerBlock)
def _transformer(graph: Graph, module: TransformerBlock, features: str) -> str:
    """Add a transformer that reads and returns features (batch, channels, ny, nx)."""
    flat = graph.add("Reshape", features, graph.constant([0, 0, -1]))
    cells = graph.add("Transpose", flat, perm=[0, 2, 1])
    assert module.linear.bias is not None
    cells = graph.add("Add", cells, _linear(graph, cells, module.linear.weight, module.linear.bias))
    for layer in module.tr:
        assert isinstance(layer, TransformerLayer)
        cells = _transformer_layer(graph, layer, cells)
    return graph.add("Reshape", graph.add("Transpose", cells, perm=[0, 2, 1]), graph.add("Shape", features))


def _transformer_layer(graph: Graph, module: TransformerLayer, cells: str) -> str:
    attended = graph.add("Add", _attention(graph, module, cells), cells)
    refined = _linear(graph, _linear(graph, attended, module.fc1.weight), module.fc2.weight)
    return graph.add("Add", refined, attended)


def _attention(graph: Graph, module: TransformerLayer, cells: str) -> str:
    attention = module.ma
    heads, size = attention.num_heads, attention.embed_dim // attention.num_heads
    assert attention.in_proj_weight is not None
    assert attention.in_proj_bias is not None
    queries, keys, values = (
        _linear(graph, _linear(graph, cells, first.weight), weight, bias)
        for first, weight, bias in zip(
            (module.q, module.k, module.v),
            attention.in_proj_weight.chunk(3),
            attention.in_proj_bias.chunk(3),
            strict=True,
        )
    )
    by_head = graph.constant([0, 0, heads, size])
    queries = graph.add("Transpose", graph.add("Reshape", queries, by_head), perm=[0, 2, 1, 3])
    keys = graph.add("Transpose", graph.add("Reshape", keys, by_head), perm=[0, 2, 3, 1])
    values = graph.add("Transpose", graph.add("Reshape", values, by_head), perm=[0, 2, 1, 3])
    queries = graph.add("Mul", queries, graph.constant(np.float32(1 / math.sqrt(size))))
    shares = graph.add("Softmax", graph.add("MatMul", queries, keys), axis=-1)
    mixed = graph.add("Transpose", graph.add("MatMul", shares, values), perm=[0, 2, 1, 3])
    joined = graph.add("Reshape", mixed, graph.constant([0, 0, attention.embed_dim]))
    return _linear(graph, joined, attention.out_proj.weight, attention.out_proj.bias)


def _linear(graph: Graph, cells: str, weight: Tensor, bias: Tensor | None = None) -> str:
    product = graph.add("MatMul", cells, graph.constant(weight.T))
    return product if bias is None else graph.add("Add", product, graph.constant(bias))


_WRITERS.update(
    {
        nn.SiLU: lambda graph, _, features: graph.add("Mul", features, graph.add("Sigmoid", features)),
        nn.Hardswish: lambda graph, _, features: graph.add(
            "Mul", features, graph.add("HardSigmoid", features, alpha=1 / 6, beta=0.5)
        ),
        nn.LeakyReLU: lambda graph, module, features: graph.add(
            "LeakyRelu", features, alpha=module.negative_slope
        ),
        nn.ReLU: lambda graph, _, features: graph.add("Relu", features),
        nn.Identity: lambda _graph, _module, features: features,
        # A fused Focus is a single convolution.
        Focus: lambda graph, module, features: written(graph, module.conv, features),
        Contract: lambda graph, module, features: graph.add("SpaceToDepth", features, blocksize=module.gain),
        Expand: lambda graph, module, features: graph.add(
            "DepthToSpace", features, blocksize=module.gain, mode="DCR"
        ),
        Concat: lambda graph, _, *features: graph.add("Concat", *features, axis=1),
    }
)
