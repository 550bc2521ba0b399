"""The network as an ONNX model of fixed size: what the compiling runtimes read."""

from __future__ import annotations

from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper
from torch import Tensor, nn

from yolov5_lifecycle.network import C3, SPPF, Bottleneck, Concat, Conv, Detect, Network

# The oldest ones that have every operator as it is used here; every runtime of today reads them.
_OPSET = 13
_IR_VERSION = 8


def onnx_graph(network: Network, size_hw: tuple[int, int]) -> bytes:
    """A serialized ONNX model of a fused `network` for frames of `size_hw`, multiples of the largest stride.

    Its input `planes` is uint8 (1, 3, h, w) RGB in 0..255; its output `raw` is float32 (N, 5 + C), the rows
    that `Network.forward` gives.
    """
    graph = _Graph(size_hw)
    pixels = graph.add("Cast", "planes", to=TensorProto.FLOAT)
    pixels = graph.add("Mul", pixels, graph.constant(np.float32(1 / 255)))
    outputs: list[str] = []
    for layer, module in zip(network.architecture.layers, network.model, strict=True):
        last = outputs[-1] if outputs else pixels
        inputs = [last if source == -1 else outputs[source] for source in layer.sources]
        outputs.append(graph.layer(module, inputs))
    return graph.serialized(outputs[-1])


class _Graph:
    """Nodes and constants, growing; a value is known by its name."""

    def __init__(self, size_hw: tuple[int, int]) -> None:
        self._size_hw = size_hw
        self._nodes: list[onnx.NodeProto] = []
        self._constants: list[TensorProto] = []

    def add(self, operator: str, *inputs: str, outputs: int = 1, **attributes: Any) -> str:
        """The (first) output of a new node; others are called the same with _1, _2 ... behind."""
        name = f"{operator}{len(self._nodes)}"
        names = [name, *(f"{name}_{index}" for index in range(1, outputs))]
        self._nodes.append(helper.make_node(operator, list(inputs), names, **attributes))
        return name

    def constant(self, value: Tensor | NDArray[Any] | np.generic) -> str:
        array = value.detach().cpu().numpy() if isinstance(value, Tensor) else np.asarray(value)
        name = f"constant{len(self._constants)}"
        self._constants.append(
            numpy_helper.from_array(np.ascontiguousarray(array).reshape(array.shape), name)
        )
        return name

    def serialized(self, raw: str) -> bytes:
        self._nodes.append(helper.make_node("Identity", [raw], ["raw"]))
        planes = helper.make_tensor_value_info("planes", TensorProto.UINT8, [1, 3, *self._size_hw])
        output = helper.make_tensor_value_info("raw", TensorProto.FLOAT, ["rows", "outputs"])
        graph = helper.make_graph(self._nodes, "yolov5", [planes], [output], self._constants)
        opset = helper.make_opsetid("", _OPSET)
        model = helper.make_model(graph, opset_imports=[opset], ir_version=_IR_VERSION)
        serialized: bytes = model.SerializeToString()
        return serialized

    def layer(self, module: nn.Module, inputs: list[str]) -> str:
        """What a layer of the architecture gives."""
        if isinstance(module, Detect):
            return self._detect(module, inputs)
        if isinstance(module, Concat):
            return self.add("Concat", *inputs, axis=1)
        if isinstance(module, nn.Upsample):
            scales = self.constant(np.array([1, 1, 2, 2], np.float32))
            # With `asymmetric` and `floor` nearest means repetition, as in torch.
            return self.add(
                "Resize",
                inputs[0],
                "",
                scales,
                coordinate_transformation_mode="asymmetric",
                mode="nearest",
                nearest_mode="floor",
            )
        return self._block(module, inputs[0])

    def _block(self, module: nn.Module, features: str) -> str:
        if isinstance(module, Conv):
            convolved = self._convolution(module.conv, features)
            return self.add("Mul", convolved, self.add("Sigmoid", convolved))
        if isinstance(module, Bottleneck):
            refined = self._block(module.cv2, self._block(module.cv1, features))
            return self.add("Add", features, refined) if module.shortcut else refined
        if isinstance(module, C3):
            refined = self._block(module.cv1, features)
            for bottleneck in module.m:
                refined = self._block(bottleneck, refined)
            return self._block(
                module.cv3, self.add("Concat", refined, self._block(module.cv2, features), axis=1)
            )
        if isinstance(module, SPPF):
            return self._sppf(module, features)
        raise TypeError(f"Expected a layer of Network, found {type(module).__name__}.")

    def _sppf(self, module: SPPF, features: str) -> str:
        kernel = module.m.kernel_size
        assert isinstance(kernel, int)
        windows = [self._block(module.cv1, features)]
        for _ in range(3):
            pooled = self.add("MaxPool", windows[-1], kernel_shape=[kernel] * 2, pads=[kernel // 2] * 4)
            windows.append(pooled)
        return self._block(module.cv2, self.add("Concat", *windows, axis=1))

    def _convolution(self, module: nn.Module, features: str) -> str:
        assert isinstance(module, nn.Conv2d)
        assert module.bias is not None, "expected a fused network"
        return self.add(
            "Conv",
            features,
            self.constant(module.weight),
            self.constant(module.bias),
            kernel_shape=list(module.kernel_size),
            strides=list(module.stride),
            pads=[int(pad) for pad in module.padding] * 2,
        )

    def _detect(self, module: Detect, levels: list[str]) -> str:
        """See `Detect.decode`; cells and anchors are constants, as the size is fixed."""
        rows, offsets, scales, anchors = [], [], [], []
        for convolution, level, stride, cells in zip(
            module.m, levels, module.strides, module.anchors, strict=True
        ):
            ny, nx = (side // stride for side in self._size_hw)
            shape = self.constant(np.array([module.anchors_per_cell, module.outputs, ny, nx], np.int64))
            grid = self.add("Reshape", self._convolution(convolution, level), shape)
            grid = self.add("Transpose", grid, perm=[0, 2, 3, 1])
            rows.append(self.add("Reshape", grid, self.constant(np.array([-1, module.outputs], np.int64))))
            cell_xy = np.stack(np.meshgrid(np.arange(nx), np.arange(ny)), axis=-1).reshape(-1, 2)
            offsets.append(np.tile((cell_xy - 0.5) * stride, (module.anchors_per_cell, 1)))
            scales.append(np.full((len(offsets[-1]), 1), 2 * stride))
            anchors.append(np.repeat((4 * stride * cells).cpu().numpy(), ny * nx, axis=0))
        sigma = self.add("Sigmoid", self.add("Concat", *rows, axis=0))
        sizes = self.constant(np.array([2, 2, module.outputs - 4], np.int64))
        sigma_xy = self.add("Split", sigma, sizes, outputs=3, axis=1)
        sigma_wh, scores = f"{sigma_xy}_1", f"{sigma_xy}_2"
        scale, offset, anchor = (
            self.constant(np.concatenate(parts).astype(np.float32)) for parts in (scales, offsets, anchors)
        )
        xy = self.add("Add", self.add("Mul", sigma_xy, scale), offset)
        wh = self.add("Mul", self.add("Mul", sigma_wh, sigma_wh), anchor)
        return self.add("Concat", xy, wh, scores, axis=1)
