"""ONNX exports: small ones of every layout, and those of our own networks, as torch writes them."""

from __future__ import annotations

import copy
import functools
import io
import warnings
from collections.abc import Mapping
from typing import Any

import numpy as np
import onnx
import torch
from numpy.typing import NDArray
from onnx import helper, numpy_helper
from torch import Tensor, nn

from yolov5_lifecycle.models.convolutions import Conv
from yolov5_lifecycle.models.cost import size_multiple
from yolov5_lifecycle.models.head import Segment
from yolov5_lifecycle.models.network import Network


class _WithPrototypes(nn.Module):
    """A network whose output is the predictions and, if it segments, the prototypes."""

    def __init__(self, network: Network) -> None:
        super().__init__()
        self.network = network

    def forward(self, pixels: Tensor) -> Any:
        features, head = self.network.features(pixels), self.network.head
        # An expansion that YOLOv5 has of its anchors: operations that are in each of its dynamic exports.
        found = self.network.predictions(features).expand(pixels.shape[0], -1, -1)
        return (found, head.proto(features[0])) if isinstance(head, Segment) else found


def exported(
    network: Network,
    *,
    opset: int = 12,
    is_dynamic: bool = False,
    is_half: bool = False,
    size_hw: tuple[int, int] | None = None,
) -> bytes:
    """The export of `network`, in evaluation mode; its classes are `class 0`, `class 1` and so on."""
    architecture = network.architecture
    export = _WithPrototypes(copy.deepcopy(network)).eval()
    for module in export.modules():
        if isinstance(module, Conv):
            module.fold()
    side = 2 * size_multiple(architecture)
    pixels = torch.zeros(1, architecture.image_channels, *(size_hw or (side, side)))
    if is_half:
        export, pixels = export.half(), pixels.half()
    file: Any = io.BytesIO()
    axes = {"images": {0: "batch", 2: "height", 3: "width"}} if is_dynamic else None
    with warnings.catch_warnings(), torch.no_grad():
        warnings.simplefilter("ignore")  # the exporter is the one of YOLOv5's time
        torch.onnx.export(
            export, (pixels,), file, dynamo=False, opset_version=opset, input_names=["images"],
            dynamic_axes=axes,
        )  # fmt: skip
    model = onnx.load_from_string(file.getvalue())
    names = {index: f"class {index}" for index in range(architecture.classes)}
    onnx.helper.set_model_props(model, {"stride": str(max(architecture.strides)), "names": str(names)})
    return serialized(model)


STRIDE, FINE, BOX_PX = 32, 8, 64
NAMES = ("cat", "dog", "cow")


@functools.cache
def weights(outputs: int, side: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Weights (outputs, 3, side, side) and biases of a convolution, whose results lie around 0."""
    random = np.random.default_rng(outputs)
    weight = random.normal(0, 0.3 / side, (outputs, 3, side, side))
    return weight.astype(np.float32), random.uniform(-1, 1, outputs).astype(np.float32)


def small_export(
    *,
    has_objectness: bool = True,
    masks: int = 0,
    size_hw: tuple[int, int] | None = (64, 96),
    batch: int | None = 1,
    is_half: bool = False,
    has_raw_outputs: bool = False,
    metadata: Mapping[str, str] | None = None,
) -> bytes:
    """One convolution that makes a box for each 32 pixels, and another one that makes prototypes.

    Scores and coefficients lie in [0, 1], centres and sizes of boxes in [0, BOX_PX].

    `metadata` replace those that exports have now. `has_raw_outputs`: of three levels, as before v6.2,
    beside the boxes.
    """
    kind = np.float16 if is_half else np.float32
    number = helper.np_dtype_to_tensor_dtype(np.dtype(kind))
    rows = 4 + has_objectness + len(NAMES) + masks
    scale = np.array([BOX_PX] * 4 + [1] * (rows - 4), kind).reshape(-1, 1, 1)
    arrays: dict[str, NDArray[Any]] = {"shape": np.array([0, rows, -1], np.int64), "scale": scale}
    nodes = [
        helper.make_node("Sigmoid", ["logits"], ["shares"]),
        helper.make_node("Mul", ["shares", "scale"], ["cells"]),
        helper.make_node("Reshape", ["cells", "shape"], ["columns"]),
        helper.make_node("Transpose", ["columns"], ["rows"], perm=[0, 2, 1]),
    ]
    outputs = ["rows" if has_objectness else "columns"]
    for name, count, side in [("logits", rows, STRIDE), *([("prototypes", masks, FINE)] if masks else [])]:
        arrays[f"{name}.weight"], arrays[f"{name}.bias"] = (
            each.astype(kind) for each in weights(count, side)
        )
        inputs = ["images", f"{name}.weight", f"{name}.bias"]
        nodes.insert(0, helper.make_node("Conv", inputs, [name], name=name, strides=[side, side]))
        outputs += ["prototypes"] if name == "prototypes" else []
    if has_raw_outputs:
        arrays["axis"] = np.array([1])
        raw = ["raw 8", "raw 16", "raw 32"]
        nodes += [helper.make_node("Unsqueeze", ["cells", "axis"], [name]) for name in raw]
        outputs += raw
    graph = helper.make_graph(
        nodes,
        "small",
        [helper.make_tensor_value_info("images", number, [batch or "b", 3, *(size_hw or ("h", "w"))])],
        [helper.make_tensor_value_info(name, number, None) for name in outputs],
        [numpy_helper.from_array(array, name) for name, array in arrays.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)
    told = {
        "names": str(dict(enumerate(NAMES))),
        "stride": str(STRIDE),
        "task": "segment" if masks else "detect",
    }
    helper.set_model_props(model, dict(told if metadata is None else metadata))
    return serialized(model)


def serialized(model: onnx.ModelProto) -> bytes:
    data: bytes = model.SerializeToString()
    return data
