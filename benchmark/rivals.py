"""Alternatives to this project's runtimes: the bare forward pass of each.

torch is imported before the package, which would change its thread waiting policy; the others are imported on
demand, as they may not be installed.
"""

from __future__ import annotations

import tempfile
import warnings
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

from benchmark.contender import Task
from benchmark.work import scene_image
from yolov5_lifecycle.checkpoints.locate import load_weights
from yolov5_lifecycle.detection.letterbox import Letterbox
from yolov5_lifecycle.models.cost import size_multiple
from yolov5_lifecycle.models.network import Network, fuse

IMAGE_SIZE = 640

Call = Callable[[], object]


def call_of(task: Task) -> Call:
    """The forward pass of the rival `task.name`, with its input prepared."""
    model = load_weights(Path(task.weights)).model
    network = Network(model.architecture)
    network.load_state_dict(model.state_dict)
    stride = size_multiple(model.architecture)
    letterbox = Letterbox.fit(task.image_hw, image_size=IMAGE_SIZE, stride=stride)
    rgb = letterbox.apply(scene_image(task.image_hw).pixels)[..., ::-1].copy()
    pixels = torch.from_numpy(rgb).permute(2, 0, 1)[None].float().contiguous() / 255
    if model.architecture.image_channels == 1:
        pixels = pixels.mean(dim=1, keepdim=True)
    return RIVALS[task.name](fuse(network), pixels)


def _eager_torch(network: Network, pixels: Tensor) -> Call:
    @torch.inference_mode()
    def forward() -> object:
        return network(pixels)

    return forward


def _channels_last(network: Network, pixels: Tensor) -> Call:
    network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    return _eager_torch(network, pixels.to(memory_format=torch.channels_last))


def _onnxruntime(network: Network, pixels: Tensor, *, spins: bool) -> Call:
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.add_session_config_entry("session.intra_op.allow_spinning", str(int(spins)))
    graph = _exported(network, pixels)
    session = onnxruntime.InferenceSession(graph, options, providers=["CPUExecutionProvider"])
    return lambda: session.run(None, {"pixels": pixels.numpy()})


def _openvino(network: Network, pixels: Tensor) -> Call:
    import openvino

    core = openvino.Core()
    graph = core.read_model(_exported(network, pixels))
    # Without the second hint it computes in bfloat16 where the CPU supports it, which changes the scores.
    hints = {"PERFORMANCE_HINT": "LATENCY", "INFERENCE_PRECISION_HINT": "f32"}
    request = core.compile_model(graph, "CPU", hints).create_infer_request()
    return lambda: request.infer([pixels.numpy()], share_inputs=True)


def _opencv(network: Network, pixels: Tensor) -> Call:
    net = cv2.dnn.readNetFromONNX(np.frombuffer(_exported(network, pixels), np.uint8))

    def forward() -> object:
        net.setInput(pixels.numpy())
        return net.forward()

    return forward


def _exported(network: Network, pixels: Tensor) -> bytes:
    """The whole network, exported to ONNX by torch."""
    with tempfile.NamedTemporaryFile(suffix=".onnx") as file, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the newer exporter that replaces this one needs another package
        torch.onnx.export(
            network, (pixels,), file.name, dynamo=False, input_names=["pixels"], opset_version=13
        )
        return file.read()


RIVALS: Mapping[str, Callable[[Network, Tensor], Call]] = {
    "eager torch": _eager_torch,
    "eager torch, channels last": _channels_last,
    "ONNX Runtime": partial(_onnxruntime, spins=True),
    "ONNX Runtime, no spinning": partial(_onnxruntime, spins=False),
    "OpenVINO": _openvino,
    "OpenCV DNN": _opencv,
}
"""Each set up as its documentation first shows, except for what its name says."""
