"""ONNX exports: small ones of every layout, and those of our own networks as YOLOv5's versions write them."""

from __future__ import annotations

import functools
import io
import warnings
from collections.abc import Mapping
from typing import Any, Literal

import numpy as np
import onnx
import torch
from numpy.typing import NDArray
from onnx import helper, numpy_helper
from torch import Tensor

from yolov5_lifecycle.models.blocks import SPP
from yolov5_lifecycle.models.convolutions import Conv
from yolov5_lifecycle.models.cost import size_multiple
from yolov5_lifecycle.models.head import Segment
from yolov5_lifecycle.models.network import Network

Era = Literal["v6.0", "v7.0", "raw", "raw with boxes"]


class _Export(Network):
    """A fused network that computes boxes in the operations of an era of YOLOv5."""

    def __init__(self, network: Network, era: Era, *, is_dynamic: bool) -> None:
        super().__init__(network.architecture)
        self.load_state_dict(network.state_dict())
        self.era, self.is_dynamic = era, is_dynamic
        self.eval()
        for module in self.modules():
            if isinstance(module, Conv):
                module.fold()
            if type(module) is SPP:
                module.forward = functools.partial(_pyramid, module)  # type: ignore[method-assign]

    def forward(self, pixels: Tensor) -> Any:
        features = self.features(pixels)
        head, rows, raw = self.head, [], []
        for number, level in enumerate(features):
            batch, _, ny, nx = level.shape
            outputs = head.m[number](level).view(batch, head.anchors_per_cell, head.outputs, ny, nx)
            cells = outputs.permute(0, 1, 3, 4, 2).contiguous()
            raw.append(cells)
            decoded = self._early(cells, number) if self.era == "v6.0" else self._late(cells, number)
            rows.append(decoded.view(batch, -1, head.outputs))
        if self.era == "raw":
            return tuple(raw)
        found = torch.cat(rows, 1)
        if isinstance(head, Segment):
            return found, head.proto(features[0])
        return (found, *raw) if self.era == "raw with boxes" else found

    def _early(self, cells: Tensor, number: int) -> Tensor:
        """Columns as slices, half a cell taken off."""
        likely = cells.sigmoid()
        place = (likely[..., 0:2] * 2 - 0.5 + self._grid(cells, 0.0)) * self.head.strides[number]
        size = (likely[..., 2:4] * 2) ** 2 * self._anchors(cells, number)
        return torch.cat((place, size, likely[..., 4:]), -1)

    def _late(self, cells: Tensor, number: int) -> Tensor:
        """Columns as parts, half a cell in the grid; for masks each part is activated on its own."""
        stride, anchors, masks = (
            self.head.strides[number],
            self._anchors(cells, number),
            self.head.coefficients,
        )
        scores = self.head.outputs - 4 - masks
        if masks:
            place, size, likely, mask = cells.split((2, 2, scores, masks), 4)
            place = (place.sigmoid() * 2 + self._grid(cells, 0.5)) * stride
            size = (size.sigmoid() * 2) ** 2 * anchors
            return torch.cat((place, size, likely.sigmoid(), mask), 4)
        place, size, likely = cells.sigmoid().split((2, 2, scores), 4)
        place = (place * 2 + self._grid(cells, 0.5)) * stride
        return torch.cat((place, (size * 2) ** 2 * anchors, likely), 4)

    def _anchors(self, cells: Tensor, number: int) -> Tensor:
        anchors = self.head.anchors[number] * self.head.strides[number]
        anchors = anchors.detach().view(1, -1, 1, 1, 2)
        ny, nx = cells.shape[2:4]
        return anchors.expand(1, -1, ny, nx, 2) if self.is_dynamic else anchors

    def _grid(self, cells: Tensor, shift: float) -> Tensor:
        ny, nx = cells.shape[2:4]
        if not self.is_dynamic:  # made once and kept, so that it is a constant of the graph
            ny, nx = int(ny), int(nx)
        rows, columns = torch.arange(ny, dtype=cells.dtype), torch.arange(nx, dtype=cells.dtype)
        grid_y, grid_x = torch.meshgrid(rows, columns, indexing="ij")
        return torch.stack((grid_x, grid_y), 2).expand(1, self.head.anchors_per_cell, ny, nx, 2) - shift


def _pyramid(module: SPP, features: Tensor) -> Tensor:
    narrow = module.cv1(features)
    merged: Tensor = module.cv2(torch.cat([narrow, *(pool(narrow) for pool in module.m.children())], 1))
    return merged


def exported(
    network: Network,
    era: Era = "v7.0",
    *,
    opset: int = 12,
    is_dynamic: bool = False,
    is_half: bool = False,
    size_hw: tuple[int, int] | None = None,
) -> bytes:
    """The export of `network`, in evaluation mode; its classes are `class 0`, `class 1` and so on."""
    architecture = network.architecture
    export = _Export(network, era, is_dynamic=is_dynamic)
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
    metadata: Mapping[str, str] | None = None,
) -> bytes:
    """One convolution that makes a box for each 32 pixels, and another one that makes prototypes.

    Scores and coefficients lie in [0, 1], centres and sizes of boxes in [0, BOX_PX].

    `metadata` replace those that exports have now.
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
