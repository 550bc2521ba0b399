"""ONNX export of the network without its last layer, at a fixed input shape."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper
from torch import Tensor, nn

from yolov5_lifecycle.models.network import C3, SPPF, Bottleneck, Concat, Conv, Network

# The oldest versions that have every operator used here; all current runtimes read them.
_OPSET = 13
_IR_VERSION = 8


def onnx_graph(network: Network, shape: tuple[int, int, int]) -> bytes:
    """A serialized ONNX model of a fused `network` for a number of frames, their height and their width.

    Height and width are multiples of the largest stride. The input `planes` is uint8 (batch, 3, h, w) RGB in
    0..255. The outputs, float32 (batch, channels, ny, nx), are the inputs of the network's last layer,
    `Detect`, which is not exported.
    """
    graph = _Graph(shape)
    pixels = graph.add("Cast", "planes", to=TensorProto.FLOAT)
    pixels = graph.add("Mul", pixels, graph.constant(np.float32(1 / 255)))
    *layers, detect = network.architecture.layers
    outputs: list[str] = []
    for layer, module in zip(layers, network.model[:-1], strict=True):
        outputs.append(graph.layer(module, [(outputs or [pixels])[source] for source in layer.sources]))
    return graph.serialized([(outputs or [pixels])[source] for source in detect.sources])


class _Graph:
    """Builder of an ONNX graph; values are referenced by name."""

    def __init__(self, shape: tuple[int, int, int]) -> None:
        self._batch, *size_hw = shape
        opset = helper.make_opsetid("", _OPSET)
        self._model = onnx.ModelProto(ir_version=_IR_VERSION, opset_import=[opset])
        self._graph = self._model.graph  # built in place, as copying large weights is slow
        self._graph.name = "yolov5"
        planes = helper.make_tensor_value_info("planes", TensorProto.UINT8, [self._batch, 3, *size_hw])
        self._graph.input.append(planes)

    def add(self, operator: str, *inputs: str, **attributes: Any) -> str:
        """Add a node; return the name of its output."""
        name = f"{operator}{len(self._graph.node)}"
        self._graph.node.append(helper.make_node(operator, list(inputs), [name], **attributes))
        return name

    def constant(self, value: Tensor | NDArray[Any] | np.generic) -> str:
        array = value.detach().cpu().numpy() if isinstance(value, Tensor) else np.asarray(value)
        name = f"constant{len(self._graph.initializer)}"
        tensor = numpy_helper.from_array(np.ascontiguousarray(array).reshape(array.shape), name)
        self._graph.initializer.append(tensor)
        return name

    def serialized(self, outputs: Sequence[str]) -> bytes:
        self._graph.output.extend(
            helper.make_tensor_value_info(name, TensorProto.FLOAT, [self._batch, None, None, None])
            for name in outputs
        )
        serialized: bytes = self._model.SerializeToString()
        return serialized

    def layer(self, module: nn.Module, inputs: list[str]) -> str:
        """Add a layer of the architecture; return the name of its output."""
        if isinstance(module, Concat):
            return self.add("Concat", *inputs, axis=1)
        if isinstance(module, nn.Upsample):
            scales = self.constant(np.array([1, 1, 2, 2], np.float32))
            # With `asymmetric` and `floor`, nearest repeats pixels, as in torch.
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
