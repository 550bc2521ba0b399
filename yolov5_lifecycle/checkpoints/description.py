"""Description of a weights file for its user, even if the file is refused."""

from __future__ import annotations

import textwrap
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path

import torch
from torch import Tensor

from yolov5_lifecycle.checkpoints.archive import Archive, read_archive
from yolov5_lifecycle.checkpoints.locate import load_weights, read_once, shown_path
from yolov5_lifecycle.checkpoints.pickle_interpreter import unpickled
from yolov5_lifecycle.checkpoints.pickled_model import model_root
from yolov5_lifecycle.checkpoints.pickled_objects import StoredTensor, modules_of, tensors_of
from yolov5_lifecycle.models.architecture import SIZES, Architecture
from yolov5_lifecycle.models.cost import size_multiple, usual_cost
from yolov5_lifecycle.models.model import Export, Model, WeightsError, shown
from yolov5_lifecycle.models.network import Network
from yolov5_lifecycle.printable import in_one_line

_LABEL = 14
_WIDTH = 100
_MAX_LINES = 3
_COUNTER = "num_batches_tracked"
_MAX_KINDS = 12
_MAX_COUNTERS = 100
_MAX_COUNTER_BYTES = 64


class Description:
    """What the file at `path` holds. `text` fits on a screen; `is_usable` if it can be loaded."""

    def __init__(self, path: Path) -> None:
        self.is_usable = False
        facts: list[tuple[str, str]] = [("file", shown_path(path))]
        with suppress(WeightsError):
            data = read_once(path)
            facts.append(("size", f"{len(data) / 1e6:.1f} MB"))
            if path.suffix.lower() in (".pt", ".pth"):
                facts.extend(_of_pickle(data))
        try:
            weights = load_weights(path)
        except WeightsError as refusal:
            reason = str(refusal).removeprefix(f"{shown_path(path)}: ")
            facts.append(("usable", f"no: {reason}"))
        else:
            self.is_usable = True
            content = weights.content
            facts.extend(_of_export(content) if isinstance(content, Export) else _of_model(content))
            facts += [("sha256", weights.sha256), ("usable", "yes")]
        self.text = "".join(_lines(label, value) for label, value in dict(facts).items() if value)


def _of_pickle(data: bytes) -> Iterator[tuple[str, str]]:
    """From the objects of a `.pt`, even if its model is refused; raises WeightsError if they are."""
    archive = read_archive(data)
    checkpoint = unpickled(archive)
    modules = modules_of(model_root(checkpoint))
    yield "layers", _counted(module.kind for path, module in modules.items() if _is_layer(path))
    yield "activations", _counted(module.kind for path, module in modules.items() if path.endswith(".act"))
    yield "trained", _training(checkpoint, dict(tensors_of(modules)), archive)


def _of_model(model: Model) -> Iterator[tuple[str, str]]:
    architecture = model.architecture
    with torch.device("meta"):
        network = Network(architecture)
    parameters = sum(parameter.numel() for parameter in network.parameters())
    activations = [type(module.act).__name__ for module in network.modules() if hasattr(module, "act")]
    yield "layers", _counted(layer.kind for layer in architecture.layers)
    yield "activations", _counted(activations)
    depth, width = architecture.depth_multiple, architecture.width_multiple
    yield "multiples", f"depth {depth:g}, width {width:g}{_size(architecture)}"
    yield "parameters", f"{parameters:,}{', fused' if architecture.is_fused else ''}"
    yield "cost", str(usual_cost(architecture))
    yield (
        "images",
        f"{_colours(architecture.image_channels)}, height and width multiples of "
        f"{size_multiple(architecture)}",
    )
    yield "strides", ", ".join(map(str, architecture.strides))
    yield (
        "anchors",
        "; ".join(
            ", ".join(f"{width:.4g}x{height:.4g}" for width, height in level)
            for level in architecture.anchors_px
        ),
    )
    if coefficients := architecture.mask_coefficients:
        yield "masks", f"{coefficients} prototypes, computed in {architecture.prototype_channels} channels"
    yield "classes", f"{architecture.classes}: {', '.join(model.class_names)}"


def _of_export(export: Export) -> Iterator[tuple[str, str]]:
    yield "boxes", "with objectness, as of YOLOv5" if export.has_objectness else "without objectness"
    size = "{1}x{0}".format(*export.size_hw) if export.size_hw else f"sides multiples of {export.stride}"
    yield (
        "images",
        f"{_colours(export.channels)}, {size}, {export.precision}, batches of {export.batch or 'any'}",
    )
    yield "masks", f"{export.mask_coefficients} prototypes" if export.mask_coefficients else ""
    yield "classes", f"{len(export.class_names)}: {', '.join(export.class_names)}"


def _colours(channels: int) -> str:
    return "grey" if channels == 1 else "colour"


def _size(architecture: Architecture) -> str:
    """The official size with the same multiples and number of levels."""
    for size, official in SIZES.items():
        if _scale(official) == _scale(architecture):
            return f", those of size {size}"
    return ""


def _scale(architecture: Architecture) -> tuple[float, ...]:
    return (
        architecture.depth_multiple,
        architecture.width_multiple,
        architecture.channel_multiple,
        len(architecture.strides),
    )


def _lines(label: str, value: str) -> str:
    """A fact in at most a few lines."""
    room = _WIDTH - _LABEL
    lines = textwrap.wrap(in_one_line(value, room * _MAX_LINES - 40), room) or [""]
    blank = " " * _LABEL
    return f"{label:<{_LABEL}}" + f"\n{blank}".join(lines) + "\n"


def _counted(kinds: Iterable[str]) -> str:
    """Such as "8 C3, 7 Conv, 1 SPPF", the most frequent first."""
    found = Counter(kinds).most_common(_MAX_KINDS)
    return ", ".join(f"{count} {shown(kind)[1:-1]}" for kind, count in found)


def _is_layer(path: str) -> bool:
    return path.startswith("model.") and path.count(".") == 1


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
