"""YOLOv5's own checkpoint files, read without running anything that is in them."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from yolov5_lifecycle.architecture import AnchorsPx
from yolov5_lifecycle.checkpoint_archive import read_archive
from yolov5_lifecycle.model import (
    MAX_CLASSES,
    Model,
    WeightsError,
    blueprint,
    check_class_names,
    checked_model,
    shown,
    whole_number,
)
from yolov5_lifecycle.module_settings import check_settings
from yolov5_lifecycle.pickle_program import check_program
from yolov5_lifecycle.pickled_module import StandIn, load_pickled, modules_of, tensors_of
from yolov5_lifecycle.pickled_names import stand_in_names
from yolov5_lifecycle.yaml_architecture import (
    MAX_ANCHORS,
    MAX_LEVELS,
    MAX_STRIDE,
    architecture_of,
    layer_kind,
)

_DTYPES = frozenset({torch.float32, torch.float16, torch.bfloat16, torch.float64, torch.int64, torch.int32})


def read_checkpoint(data: bytes) -> Model:
    """The model in the bytes of a `.pt` file; its `ema` where there is one, as YOLOv5 itself prefers.

    The pickle is read twice: first with tensors that take no memory, and only when all their sizes are sound
    for real. Raises WeightsError.
    """
    archive = read_archive(data)
    names = stand_in_names(archive.pickle)
    check_program(archive.pickle, names)
    claimed = _root(load_pickled(archive, names, device="meta"))
    _check_sizes(dict(tensors_of(modules_of(claimed))), len(data))
    modules = modules_of(_root(load_pickled(archive, names, device="cpu")))
    tensors = dict(tensors_of(modules))
    _check_sizes(tensors, len(data))
    return _model(modules, tensors)


def _root(checkpoint: object) -> StandIn:
    if isinstance(checkpoint, StandIn):
        raise WeightsError(
            f"expected a checkpoint of YOLOv5's train.py, found a bare module, {shown(checkpoint)}"
        )
    if not isinstance(checkpoint, dict):
        raise WeightsError(f"expected a dict with the entry 'model', found {shown(checkpoint)}")
    for key in ("ema", "model"):
        if isinstance(module := checkpoint.get(key), StandIn):
            return module
    states = [checkpoint, *(checkpoint.get(key) for key in ("ema", "model", "state_dict"))]
    if any(isinstance(state, dict) and _holds_tensors(state) for state in states):
        raise WeightsError(
            "this is a bare state dict, without the model's yaml and class names: use the original .pt"
        )
    raise WeightsError(
        f"expected a YOLOv5 model under 'ema' or 'model', found {shown(checkpoint.get('model'))}"
    )


def _holds_tensors(state: Mapping[object, object]) -> bool:
    return bool(state) and all(isinstance(value, Tensor) for value in state.values())


def _check_sizes(tensors: Mapping[str, Tensor], file_bytes: int) -> None:
    """No tensor may claim more than the file can hold: a stride of 0 repeats one number for ever."""
    total_bytes = 0
    for key, tensor in tensors.items():
        if tensor.layout is not torch.strided or tensor.dtype not in _DTYPES:
            raise WeightsError(f"{shown(key)} holds {tensor.dtype} ({tensor.layout}): not supported")
        if any(stride <= 0 for stride, size in zip(tensor.stride(), tensor.shape, strict=True) if size > 1):
            raise WeightsError(f"{shown(key)} has the strides {tensor.stride()}: its numbers overlap")
        total_bytes += tensor.numel() * tensor.element_size()
    if total_bytes > file_bytes:
        raise WeightsError(f"its tensors claim {total_bytes} bytes, but the file has {file_bytes}")


def _model(modules: Mapping[str, StandIn], tensors: Mapping[str, Tensor]) -> Model:
    root = modules[""]
    head_path = _head_path(modules)
    classes = _classes(modules[head_path])
    strides = _strides(root.get("stride"))
    architecture = architecture_of(
        root.get("yaml"),
        classes=classes,
        anchors_px=_anchors_px(tensors.get(f"{head_path}.anchors"), strides),
        strides=strides,
    )
    check_settings(modules, blueprint(architecture))
    return checked_model(architecture, check_class_names(root.get("names"), classes), tensors)


def _head_path(modules: Mapping[str, StandIn]) -> str:
    layers = modules["model"].group("_modules") if "model" in modules else {}
    if not layers:
        raise WeightsError(f"expected a YOLOv5 model, found a {shown(modules[''].kind)} without layers")
    path = f"model.{list(layers)[-1]}"
    if layer_kind(modules[path].kind, "the last layer") != "Detect":
        raise WeightsError(f"the last layer is a {modules[path].kind}, expected Detect")
    return path


def _classes(head: StandIn) -> int:
    classes = whole_number(head.get("nc"), "the number of classes", 1, MAX_CLASSES)
    outputs = head.get("no")
    if not isinstance(outputs, int) or outputs != classes + 5:
        raise WeightsError(
            f"the Detect layer gives {shown(outputs)} numbers a box, expected {classes + 5} for {classes} "
            "classes: the head of another kind of model, or a damaged file"
        )
    return classes


def _strides(stride: object) -> tuple[int, ...]:
    if not isinstance(stride, Tensor) or stride.dim() != 1 or not 1 <= stride.numel() <= MAX_LEVELS:
        raise WeightsError(f"expected the strides of 1 to {MAX_LEVELS} levels, found {shown(stride)}")
    values = stride.tolist()
    if not all(value in range(1, MAX_STRIDE + 1) for value in values):
        raise WeightsError(f"expected strides from 1 to {MAX_STRIDE}, found {shown(values)}")
    return tuple(map(int, values))


def _anchors_px(anchors: Tensor | None, strides: tuple[int, ...]) -> AnchorsPx:
    """Anchors in pixels from the buffer in grid cells, (levels, anchors, 2)."""
    shape = () if anchors is None else tuple(anchors.shape)
    if anchors is None or len(shape) != 3 or shape[0] != len(strides) or shape[2] != 2:
        raise WeightsError(
            f"expected anchors (width, height) for {len(strides)} levels, found the shape {shape}"
        )
    if not 1 <= shape[1] <= MAX_ANCHORS:
        raise WeightsError(f"expected 1 to {MAX_ANCHORS} anchors on each level, found {shape[1]}")
    scale = torch.tensor(strides, dtype=torch.float64).view(-1, 1, 1)
    return tuple(
        tuple((float(width), float(height)) for width, height in level)
        for level in (anchors.double() * scale).tolist()
    )
