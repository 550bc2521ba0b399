"""What a user could take instead of this project's runtimes: the bare forward of each.

torch is imported before the package, which would change how OpenMP waits; the others when they are asked for,
as they may be absent.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from benchmark.task import Task
from benchmark.work import scene_picture
from yolov5_lifecycle.letterbox import Letterbox
from yolov5_lifecycle.network import Network, fuse
from yolov5_lifecycle.runtimes.onnx_graph import onnx_graph
from yolov5_lifecycle.weights import load_weights

IMAGE_SIZE = 640

Call = Callable[[], object]


def call_of(task: Task) -> Call:
    """The forward of the rival called `task.name`, its input ready."""
    model = load_weights(Path(task.weights)).model
    network = Network(model.architecture)
    network.load_state_dict(model.state_dict)
    stride = max(model.architecture.strides)
    letterbox = Letterbox.fit(task.picture_hw, image_size=IMAGE_SIZE, stride=stride)
    rgb = letterbox.apply(scene_picture(task.picture_hw).pixels)[..., ::-1]
    return RIVALS[task.name](fuse(network), np.ascontiguousarray(rgb.transpose(2, 0, 1)[None]))


def _eager_torch(network: Network, planes: NDArray[np.uint8]) -> Call:
    pixels = torch.from_numpy(planes).float() / 255

    @torch.inference_mode()
    def forward() -> object:
        return network(pixels)

    return forward


def _channels_last(network: Network, planes: NDArray[np.uint8]) -> Call:
    pixels = (torch.from_numpy(planes).float() / 255).to(memory_format=torch.channels_last)
    network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    @torch.inference_mode()
    def forward() -> object:
        return network(pixels)

    return forward


def _onnxruntime(network: Network, planes: NDArray[np.uint8], *, spins: bool) -> Call:
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.add_session_config_entry("session.intra_op.allow_spinning", str(int(spins)))
    graph = onnx_graph(network, (planes.shape[2], planes.shape[3]))
    session = onnxruntime.InferenceSession(graph, options, providers=["CPUExecutionProvider"])
    return lambda: session.run(["raw"], {"planes": planes})


def _openvino(network: Network, planes: NDArray[np.uint8]) -> Call:
    import openvino

    core = openvino.Core()
    graph = core.read_model(onnx_graph(network, (planes.shape[2], planes.shape[3])))
    # Without the second hint it computes in bfloat16 where the CPU can, and the scores are others.
    hints = {"PERFORMANCE_HINT": "LATENCY", "INFERENCE_PRECISION_HINT": "f32"}
    request = core.compile_model(graph, "CPU", hints).create_infer_request()
    return lambda: request.infer([planes], share_inputs=True)


def _opencv(network: Network, planes: NDArray[np.uint8]) -> Call:
    graph = np.frombuffer(onnx_graph(network, (planes.shape[2], planes.shape[3])), np.uint8)
    net = cv2.dnn.readNetFromONNX(graph)

    def forward() -> object:
        net.setInput(planes)
        return net.forward()

    return forward


RIVALS: Mapping[str, Callable[[Network, NDArray[np.uint8]], Call]] = {
    "eager torch": _eager_torch,
    "eager torch, channels last": _channels_last,
    "ONNX Runtime": partial(_onnxruntime, spins=True),
    "ONNX Runtime, no spinning": partial(_onnxruntime, spins=False),
    "OpenVINO": _openvino,
    "OpenCV DNN": _opencv,
}
"""Each as its documentation shows it first, but for what its name says."""
