"""YOLOv5 `.pt` checkpoints, read without executing anything in them."""

from __future__ import annotations

import sys
from collections.abc import Mapping

from torch import Tensor

from yolov5_lifecycle.checkpoints.archive import Archive, read_archive
from yolov5_lifecycle.checkpoints.pickle_interpreter import unpickled
from yolov5_lifecycle.checkpoints.pickled_model import (
    anchors_of,
    as_pickled,
    check_settings,
    classes_of,
    head_path,
    model_root,
    strides_of,
)
from yolov5_lifecycle.checkpoints.pickled_objects import StoredTensor, Stub, modules_of, tensors_of
from yolov5_lifecycle.checkpoints.yaml_architecture import architecture_of
from yolov5_lifecycle.models.model import (
    DTYPES,
    Model,
    WeightsError,
    blueprint,
    check_class_names,
    check_fit,
    checked_model,
    shown,
)

_ORIGINAL, _MASK = "_orig", "_mask"
"""What the names of a weight before pruning, and of the ones and zeros to multiply it by, end in."""
MAX_SURPLUS_BYTES = 64 << 20
MAX_SURPLUS = 8
"""Max ratio of other bytes in a file to the bytes of its layers, beyond `MAX_SURPLUS_BYTES`.

A training checkpoint of YOLOv5 has its EMA in fp16, the model itself and the state of its optimizer, which
for Adam is two fp32 values per weight, three with amsgrad.
"""


def read_checkpoint(data: bytes) -> Model:
    """The model in the bytes of a `.pt` file; its `ema` if present, as YOLOv5 itself prefers.

    Tensor data is read once all tensors are known to fit the layers, each storage once; that of no layer is
    never read.
    Raises WeightsError.
    """
    archive = read_archive(data)
    modules = modules_of(model_root(unpickled(archive)))
    # Until v5.0 the anchors are there twice, the second time in pixels.
    stored = {key: tensor for key, tensor in tensors_of(modules) if not key.endswith(".anchor_grid")}
    tensors = _named_like_layers(stored)
    _check_storages(tensors, archive)
    _check_sizes(tensors, len(data))
    return _model(modules, tensors, archive)


def _named_like_layers(tensors: Mapping[str, StoredTensor]) -> dict[str, StoredTensor]:
    """`tensors` with the weights that torch.nn.utils.prune renamed by their own names, beside their masks."""
    return {
        key.removesuffix(_ORIGINAL) if f"{key.removesuffix(_ORIGINAL)}{_MASK}" in tensors else key: tensor
        for key, tensor in tensors.items()
    }


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
        if tensor.dtype not in DTYPES:
            raise WeightsError(f"{shown(key)} holds {tensor.dtype}: not supported")
        if tensor.repeats_numbers:
            raise WeightsError(f"{shown(key)} has the strides {shown(tensor.strides)}: its numbers overlap")
    total_bytes = sum(tensor.size_bytes for tensor in tensors.values())
    if total_bytes > file_bytes:
        raise WeightsError(f"its tensors claim {total_bytes} bytes, but the file has {file_bytes}")
    surplus_bytes = file_bytes - total_bytes
    if surplus_bytes > MAX_SURPLUS * total_bytes + MAX_SURPLUS_BYTES:
        raise WeightsError(
            f"the file has {surplus_bytes} bytes that belong to no layer, and {total_bytes} that do: more "
            "than any training leaves behind; get the original file, or convert that"
        )


def _model(modules: Mapping[str, Stub], stored: Mapping[str, StoredTensor], archive: Archive) -> Model:
    root, head = modules[""], head_path(modules)
    classes = classes_of(modules[head])

    def read(tensor: StoredTensor) -> Tensor:
        return tensor.of(archive.storage(tensor.storage.key))

    strides = strides_of(root, read)
    architecture = architecture_of(
        _with_channels(root.get("yaml"), stored, modules.get("model.0")),
        classes=classes,
        anchors_px=anchors_of(stored.get(f"{head}.anchors"), strides, read),
        strides=strides,
    )
    architecture = as_pickled(architecture, modules)
    network = blueprint(architecture)
    check_settings(modules, network)
    names = check_class_names(root.get("names"), classes)
    expected = network.state_dict()
    masks = {f"{key}{_MASK}": key for key in expected if f"{key}{_MASK}" in stored}
    expected |= {mask: expected[key] for mask, key in masks.items()}
    check_fit(expected, {key: tensor.on_meta() for key, tensor in stored.items()})
    _check_byte_order(archive)
    tensors = {key: read(tensor) for key, tensor in stored.items()}
    for mask, key in masks.items():
        tensors[key] = tensors[key] * tensors.pop(mask)
    return checked_model(architecture, names, tensors)


def _with_channels(yaml: object, stored: Mapping[str, StoredTensor], first: Stub | None) -> object:
    """`yaml` with the channels of images; before v6.0 only the weights of the `first` layer tell them."""
    shapes = (tensor.shape for key, tensor in stored.items() if key.startswith("model.0."))
    shape = next((shape for shape in shapes if len(shape) == 4), (0, 3))
    channels = shape[1] // 4 if first is not None and first.kind == "Focus" else shape[1]
    return {"ch": channels} | yaml if isinstance(yaml, dict) else yaml


def _check_byte_order(archive: Archive) -> None:
    """Reject foreign byte order. Torch before 2.1 records none, but hardly ran on big-endian machines."""
    if archive.has("byteorder") and (order := archive.record("byteorder")) != sys.byteorder.encode():
        raise WeightsError(
            f"its numbers are in the byte order {shown(str(order[:16]))}: save it on this machine"
        )
