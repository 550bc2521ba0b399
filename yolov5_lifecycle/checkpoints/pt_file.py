"""YOLOv5 `.pt` checkpoints, read without executing anything in them."""

from __future__ import annotations

import sys
from collections.abc import Mapping

import torch
from torch import Tensor

from yolov5_lifecycle.checkpoints.archive import PICKLE, Archive, read_archive
from yolov5_lifecycle.checkpoints.layer_settings import check_settings
from yolov5_lifecycle.checkpoints.module_tree import Stub, load_pickled, modules_of, tensors_of
from yolov5_lifecycle.checkpoints.pickle_safety import check_program
from yolov5_lifecycle.checkpoints.pickled_names import stub_names
from yolov5_lifecycle.checkpoints.stored_tensor import StoredTensor
from yolov5_lifecycle.checkpoints.yaml_architecture import (
    MAX_ANCHORS,
    MAX_LEVELS,
    MAX_STRIDE,
    architecture_of,
    layer_kind,
)
from yolov5_lifecycle.models.architecture import AnchorsPx
from yolov5_lifecycle.models.model import (
    MAX_CLASSES,
    Model,
    WeightsError,
    blueprint,
    check_class_names,
    check_fit,
    checked_integer,
    checked_model,
    shown,
)

_WRAPPERS = ("AutoShape", "autoShape", "DetectMultiBackend")
_PLACEHOLDER_ANCHORS_PX = tuple((float(2 * index), float(2 * index + 1)) for index in range(MAX_ANCHORS))
"""Anchors that YOLOv5 creates for `anchors: 3` in the yaml of P2, P34, P6 and P7 models."""
_DTYPES = frozenset({torch.float32, torch.float16, torch.bfloat16, torch.float64, torch.int64, torch.int32})


MAX_SURPLUS_BYTES = 64 << 20
MAX_SURPLUS = 8
"""Maximum ratio of other bytes in a file to the bytes of its layers, beyond `MAX_SURPLUS_BYTES`.

A training checkpoint of YOLOv5 has its EMA in fp16, the model itself and the state of its optimizer, which
for Adam is two fp32 values per weight, three with amsgrad.
"""


def read_checkpoint(data: bytes) -> Model:
    """The model in the bytes of a `.pt` file; its `ema` if present, as YOLOv5 itself prefers.

    Tensor data is read once all tensors are known to fit the layers; data of no layer is never read.
    Raises WeightsError.
    """
    archive = read_archive(data)
    pickle = archive.record(PICKLE)
    names = stub_names(pickle)
    check_program(pickle, names)
    modules = modules_of(_root(load_pickled(pickle, names)))
    tensors = dict(tensors_of(modules))
    _check_storages(tensors, archive)
    _check_sizes(tensors, len(data))
    return _model(modules, tensors, archive)


def _root(checkpoint: object) -> Stub:
    if isinstance(checkpoint, Stub):
        raise WeightsError(
            f"expected a checkpoint of YOLOv5's train.py, found a bare module, {shown(checkpoint)}"
        )
    if not isinstance(checkpoint, dict):
        raise WeightsError(f"expected a dict with the entry 'model', found {shown(checkpoint)}")
    for key in ("ema", "model"):
        if isinstance(module := checkpoint.get(key), Stub):
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
    return bool(state) and all(isinstance(value, StoredTensor) for value in state.values())


def _check_storages(tensors: Mapping[str, StoredTensor], archive: Archive) -> None:
    for key, tensor in tensors.items():
        found_bytes = archive.storage_bytes(tensor.storage.key)
        if found_bytes != tensor.storage.size_bytes:
            raise WeightsError(
                f"the storage of {shown(key)} claims {tensor.storage.size_bytes} bytes, but has "
                f"{found_bytes}: copy or download the file again"
            )


def _check_sizes(tensors: Mapping[str, StoredTensor], file_bytes: int) -> None:
    """Raise WeightsError if tensors claim more bytes than the file has, or only a small part of it."""
    for key, tensor in tensors.items():
        if tensor.dtype not in _DTYPES:
            raise WeightsError(f"{shown(key)} holds {tensor.dtype}: not supported")
        if tensor.repeats_numbers:
            raise WeightsError(f"{shown(key)} has the strides {shown(tensor.strides)}: its numbers overlap")
    total_bytes = sum(tensor.size_bytes for tensor in tensors.values())
    if total_bytes > file_bytes:
        raise WeightsError(f"its tensors claim {total_bytes} bytes, but the file has {file_bytes}")
    surplus_bytes = file_bytes - total_bytes
    if surplus_bytes > MAX_SURPLUS * total_bytes + MAX_SURPLUS_BYTES:
        raise WeightsError(
            f"the file has {surplus_bytes} bytes that belong to no layer, beside {total_bytes} that do: more "
            "than any training leaves behind; get the original file, or convert that"
        )


def _model(modules: Mapping[str, Stub], stored: Mapping[str, StoredTensor], archive: Archive) -> Model:
    root = modules[""]
    head_path = _head_path(modules)
    classes = _classes(modules[head_path])
    strides = _strides(root.get("stride"), archive)
    architecture = architecture_of(
        root.get("yaml"),
        classes=classes,
        anchors_px=_anchors_px(stored.get(f"{head_path}.anchors"), strides, archive),
        strides=strides,
    )
    network = blueprint(architecture)
    check_settings(modules, network)
    names = check_class_names(root.get("names"), classes)
    check_fit(network.state_dict(), {key: tensor.on_meta() for key, tensor in stored.items()})
    _check_byte_order(archive)
    return checked_model(architecture, names, {key: _read(tensor, archive) for key, tensor in stored.items()})


def _read(tensor: StoredTensor, archive: Archive) -> Tensor:
    return tensor.of(archive.storage(tensor.storage.key))


def _check_byte_order(archive: Archive) -> None:
    """Reject foreign byte order. Torch before 2.1 records none, but hardly ran on big-endian machines."""
    if archive.has("byteorder") and (order := archive.record("byteorder")) != sys.byteorder.encode():
        raise WeightsError(f"its numbers are in the byte order {shown(str(order))}: save it on this machine")


def _head_path(modules: Mapping[str, Stub]) -> str:
    if (wrapper := modules[""].kind) in _WRAPPERS:
        raise WeightsError(
            f"the model was saved inside {wrapper}, which YOLOv5 puts around it to run it: use the "
            "checkpoint of the training"
        )
    layers = modules["model"].group("_modules") if "model" in modules else {}
    if not layers:
        raise WeightsError(f"expected a YOLOv5 model, found a {shown(modules[''].kind)} without layers")
    path = f"model.{list(layers)[-1]}"
    if layer_kind(modules[path].kind, "the last layer") != "Detect":
        raise WeightsError(f"the last layer is a {modules[path].kind}, expected Detect")
    return path


def _classes(head: Stub) -> int:
    classes = checked_integer(head.get("nc"), "the number of classes", 1, MAX_CLASSES)
    outputs = head.get("no")
    if not isinstance(outputs, int) or outputs != classes + 5:
        raise WeightsError(
            f"the Detect layer gives {shown(outputs)} numbers a box, expected {classes + 5} for {classes} "
            "classes: the head of another kind of model, or a damaged file"
        )
    return classes


def _strides(stride: object, archive: Archive) -> tuple[int, ...]:
    if (
        not isinstance(stride, StoredTensor)
        or len(stride.shape) != 1
        or not 1 <= stride.shape[0] <= MAX_LEVELS
    ):
        raise WeightsError(f"expected the strides of 1 to {MAX_LEVELS} levels, found {shown(stride)}")
    values = _read(stride, archive).tolist()
    if not all(value in range(1, MAX_STRIDE + 1) for value in values):
        raise WeightsError(f"expected strides from 1 to {MAX_STRIDE}, found {shown(values)}")
    return tuple(map(int, values))


def _anchors_px(anchors: StoredTensor | None, strides: tuple[int, ...], archive: Archive) -> AnchorsPx:
    """Anchors in pixels from the buffer in grid cells, (levels, anchors, 2)."""
    shape = () if anchors is None else anchors.shape
    if anchors is None or len(shape) != 3 or shape[0] != len(strides) or shape[2] != 2:
        raise WeightsError(
            f"expected anchors (width, height) for {len(strides)} levels, found the shape {shape}"
        )
    if not 1 <= shape[1] <= MAX_ANCHORS:
        raise WeightsError(f"expected 1 to {MAX_ANCHORS} anchors on each level, found {shape[1]}")
    scale = torch.tensor(strides, dtype=torch.float64).view(-1, 1, 1)
    anchors_px = tuple(
        tuple((float(width), float(height)) for width, height in level)
        for level in (_read(anchors, archive).double() * scale).tolist()
    )
    if all(level == _PLACEHOLDER_ANCHORS_PX[: len(level)] for level in anchors_px):
        raise WeightsError(
            "the model was never trained: its anchors are still the placeholders (0, 1), (2, 3), ..., which "
            "training replaces; train it first"
        )
    return anchors_px
