"""Compiled networks that take float pixels, to compare them with networks of other implementations."""

from __future__ import annotations

from typing import cast

import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.models.model import Model
from yolov5_lifecycle.models.network import Network, fuse
from yolov5_lifecycle.runtimes.compiler import Engine, Threads
from yolov5_lifecycle.runtimes.networks_by_shape import denormals_as_zero
from yolov5_lifecycle.runtimes.sparse_head import DetectionHead


def engine(runtime_name: str) -> Engine:
    """Imported here, because its package may be absent."""
    if runtime_name == "onnxruntime":
        from yolov5_lifecycle.runtimes.onnxruntime_runtime import onnxruntime_engine

        return onnxruntime_engine()
    from yolov5_lifecycle.runtimes.openvino_runtime import openvino_engine

    return openvino_engine()


def predicted(model: Model, engine: Engine, pixels: NDArray[np.float32]) -> NDArray[np.float32]:
    """All predictions (N, 5 + C) for `pixels` (1, 3, h, w) in [0, 1], with the parts of `CompiledRuntime`."""
    network = fuse(model.network())
    height, width = pixels.shape[2:]
    detect = network.head
    with denormals_as_zero():  # the engines leave the calling thread in that mode, which is ended here
        loaded, _ = engine.build(graph_of_pixels(network, (height, width)), Threads(each=1))
        return DetectionHead(detect)(loaded.new_run()(cast("NDArray[np.uint8]", pixels)), 0.0)


def graph_of_pixels(network: Network, size_hw: tuple[int, int]) -> bytes:
    """The graph of `onnx_graph` without the conversion of its input: it takes float32 pixels in [0, 1]."""
    import onnx

    from yolov5_lifecycle.runtimes.onnx_graph import onnx_graph

    model = onnx.load_from_string(onnx_graph(network, size_hw))
    graph = model.graph
    as_float, scaled = graph.node[:2]
    assert (as_float.op_type, scaled.op_type) == ("Cast", "Mul")
    graph.input[0].type.tensor_type.elem_type = onnx.TensorProto.FLOAT
    for node in graph.node:
        node.input[:] = [graph.input[0].name if name == scaled.output[0] else name for name in node.input]
    del graph.node[:2]
    content: bytes = model.SerializeToString()
    return content
