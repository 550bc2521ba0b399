"""Facts about a checkpoint from its pickled objects, even if its model is refused."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from typing import NamedTuple

from torch import Tensor

from yolov5_lifecycle.checkpoints.archive import Archive, read_archive
from yolov5_lifecycle.checkpoints.module_tree import Stub, modules_of, tensors_of, unpickled
from yolov5_lifecycle.checkpoints.pickled_model import model_root
from yolov5_lifecycle.checkpoints.stored_tensor import StoredTensor
from yolov5_lifecycle.models.model import WeightsError, shown

_COUNTER = "num_batches_tracked"
_MAX_KINDS = 12
_MAX_COUNTERS = 100
_MAX_COUNTER_BYTES = 64


class PickledFacts(NamedTuple):
    """Facts for a user; each is "" if the file lacks it."""

    version: str
    layers: str
    activations: str
    training: str


def pickled_facts(data: bytes) -> PickledFacts:
    """The facts in the bytes of a `.pt` file; raises WeightsError if its objects cannot be read safely."""
    archive = read_archive(data)
    checkpoint = unpickled(archive)
    modules = modules_of(model_root(checkpoint))
    tensors = dict(tensors_of(modules))
    return PickledFacts(
        version=_version(modules, tensors),
        layers=counted(module.kind for path, module in modules.items() if _is_layer(path)),
        activations=counted(module.kind for path, module in modules.items() if path.endswith(".act")),
        training=_training(checkpoint, tensors, archive),
    )


def counted(kinds: Iterable[str]) -> str:
    """Such as "8 C3, 7 Conv, 1 SPPF", the most frequent first."""
    found = Counter(kinds).most_common(_MAX_KINDS)
    return ", ".join(f"{count} {shown(kind)[1:-1]}" for kind, count in found)


def _is_layer(path: str) -> bool:
    return path.startswith("model.") and path.count(".") == 1


def _version(modules: Mapping[str, Stub], tensors: Mapping[str, StoredTensor]) -> str:
    """The version of YOLOv5 that wrote the model, inferred from differences between versions."""
    convolutions = [path for path, module in modules.items() if module.kind in ("Conv", "DWConv")]
    activations = [modules[f"{path}.act"] for path in convolutions if f"{path}.act" in modules]
    kinds = {module.kind for module in activations}
    if any(key.endswith(".anchor_grid") for key in tensors):
        return {"Hardswish": "v3.1", "LeakyReLU": "v3.0", "SiLU": "v4.0 or v5.0"}.get(
            "".join(kinds), "v3.0 to v5.0"
        )
    is_in_place = any(module.get("inplace") is True for module in activations)
    if modules[""].kind == "Model":
        return "v6.1" if is_in_place else "v6.0"
    if len({id(module) for module in activations}) > 1 and kinds == {"SiLU"}:
        return "v6.2"
    return "v7.0" if is_in_place else "later than v7.0, or v7.0 with an activation of its own"


def _training(checkpoint: object, tensors: Mapping[str, StoredTensor], archive: Archive) -> str:
    counters = [tensor for key, tensor in tensors.items() if key.endswith(_COUNTER)]
    if not counters:
        return "unknown: the normalisation was merged into the convolutions"
    try:
        has_seen_images = any(bool(_read(counter, archive).any()) for counter in counters[:_MAX_COUNTERS])
    except (WeightsError, RuntimeError):
        return ""
    if not has_seen_images:
        return "never: its normalisation has seen no images"
    date = checkpoint.get("date") if isinstance(checkpoint, dict) else None
    return f"yes, saved {shown(date)[1:-1]}" if isinstance(date, str) else "yes"


def _read(counter: StoredTensor, archive: Archive) -> Tensor:
    if counter.size_bytes > _MAX_COUNTER_BYTES:
        raise WeightsError("a counter of many numbers")
    return counter.of(archive.storage(counter.storage.key))
