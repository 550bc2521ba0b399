"""YOLOv5's own checkpoint files, read without running anything that is in them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from yolov5_lifecycle.architecture import AnchorsPx
from yolov5_lifecycle.checkpoint_archive import check_archive
from yolov5_lifecycle.model import MAX_CLASSES, Model, WeightsError, check_class_names, checked_model
from yolov5_lifecycle.pickled_module import StandIn, load_pickled, tensors_of
from yolov5_lifecycle.yaml_architecture import architecture_of

_DTYPES = frozenset({torch.float32, torch.float16, torch.bfloat16, torch.float64, torch.int64, torch.int32})


def read_checkpoint(data: bytes) -> Model:
    """The model in the bytes of a `.pt` file; its `ema` where there is one, as YOLOv5 itself prefers.

    The pickle is read twice: first with tensors that take no memory, and only when all their sizes are sound
    for real. Raises WeightsError.
    """
    check_archive(data)
    claimed = _tensors(_module(load_pickled(data, device="meta")))
    _check_sizes(claimed, len(data))
    module = _module(load_pickled(data, device="cpu"))
    tensors = _tensors(module)
    _check_sizes(tensors, len(data))
    return _model(module, tensors)


def _module(checkpoint: object) -> StandIn:
    if not isinstance(checkpoint, dict):
        raise WeightsError(
            f"expected a dict with the entry 'model', found a {type(checkpoint).__name__[:40]}"
        )
    for key in ("ema", "model"):
        if isinstance(module := checkpoint.get(key), StandIn):
            return module
    if all(isinstance(value, Tensor) for value in checkpoint.values()) and checkpoint:
        raise WeightsError(
            "this is a bare state dict, without the model's yaml and class names: use the original .pt"
        )
    raise WeightsError("expected a YOLOv5 checkpoint, found no module under 'ema' or 'model'")


def _tensors(module: StandIn) -> dict[str, Tensor]:
    return dict(tensors_of(module))


def _check_sizes(tensors: Mapping[str, Tensor], file_bytes: int) -> None:
    """No tensor may claim more than the file can hold: a stride of 0 repeats one number for ever."""
    total_bytes = 0
    for key, tensor in tensors.items():
        if tensor.dtype not in _DTYPES or tensor.layout is not torch.strided or tensor.is_quantized:
            raise WeightsError(f"{key[:80]} is a tensor of type {tensor.dtype}, {tensor.layout}")
        if any(stride <= 0 for stride, size in zip(tensor.stride(), tensor.shape, strict=True) if size > 1):
            raise WeightsError(f"{key[:80]} has the strides {tensor.stride()}: its numbers overlap")
        total_bytes += tensor.numel() * tensor.element_size()
    if total_bytes > file_bytes:
        raise WeightsError(f"its tensors claim {total_bytes} bytes, the file has {file_bytes}")


def _model(module: StandIn, tensors: Mapping[str, Tensor]) -> Model:
    head_name, head = _head(module)
    classes = head.get("nc")
    if not isinstance(classes, int) or not 1 <= classes <= MAX_CLASSES:
        raise WeightsError(f"the Detect layer has {str(classes)[:40]} classes, expected 1 to {MAX_CLASSES}")
    if head.get("no") != classes + 5:
        raise WeightsError(
            f"the Detect layer gives {str(head.get('no'))[:40]} numbers a box for {classes} classes, "
            f"expected {classes + 5}: a segmentation model or a damaged file"
        )
    strides = _strides(module)
    architecture = architecture_of(
        module.get("yaml"),
        classes=classes,
        anchors_px=_anchors_px(tensors.get(f"{head_name}.anchors"), strides),
        strides=strides,
    )
    return checked_model(architecture, check_class_names(module.get("names"), classes), tensors)


def _head(module: StandIn) -> tuple[str, StandIn]:
    """The last layer and the prefix of its keys."""
    layers = module.group("_modules").get("model")
    if not isinstance(layers, StandIn) or not layers.children:
        raise WeightsError("the model has no layers")
    name, head = list(layers.group("_modules").items())[-1]
    kind = head.pickled_name.rpartition(".")[2] if isinstance(head, StandIn) else "?"
    if kind in ("Segment", "Classify"):
        raise WeightsError(
            f"this is a {kind.lower()} model ({head.pickled_name}); only detection models are supported"
        )
    if kind != "Detect":
        raise WeightsError(f"the last layer is a {kind[:40]}, expected Detect")
    return f"model.{name}", head


def _strides(module: StandIn) -> tuple[int, ...]:
    stride = module.get("stride")
    if not isinstance(stride, Tensor) or stride.dim() != 1 or not 1 <= stride.numel() <= 8:
        raise WeightsError("the model does not tell its strides")
    strides = tuple(stride.tolist())
    if any(value != int(value) or not 1 <= value <= 1024 for value in strides if value == value) or any(
        value != value for value in strides
    ):
        raise WeightsError(f"the strides {strides} are not whole numbers from 1 to 1024")
    return tuple(int(value) for value in strides)


def _anchors_px(anchors: Any, strides: tuple[int, ...]) -> AnchorsPx:
    """Anchors in pixels from the buffer in grid cells, (levels, anchors, 2)."""
    if not isinstance(anchors, Tensor) or anchors.dim() != 3 or anchors.shape[0] != len(strides):
        raise WeightsError(f"expected anchors for each of {len(strides)} levels")
    if anchors.shape[2] != 2 or not 1 <= anchors.shape[1] <= 32:
        raise WeightsError(
            f"expected anchors of width and height, found a tensor of shape {tuple(anchors.shape)}"
        )
    scale = torch.tensor(strides, dtype=torch.float64).view(-1, 1, 1)
    return tuple(
        tuple((float(width), float(height)) for width, height in level)
        for level in (anchors.double() * scale).tolist()
    )
