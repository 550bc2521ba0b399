"""Description of a weights file for its user, even if the file is refused."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import torch

from yolov5_lifecycle.checkpoints.locate import load_weights, read_once, shown_path
from yolov5_lifecycle.checkpoints.pickled_facts import PickledFacts, counted, pickled_facts
from yolov5_lifecycle.models.architecture import SIZES, Architecture
from yolov5_lifecycle.models.cost import usual_cost
from yolov5_lifecycle.models.export import Export
from yolov5_lifecycle.models.geometry import size_multiple
from yolov5_lifecycle.models.model import Model, WeightsError
from yolov5_lifecycle.models.network import Network
from yolov5_lifecycle.printable import in_one_line

_LABEL = 14
_WIDTH = 100
_MAX_LINES = 3


class Description:
    """What the file at `path` holds. `text` fits on a screen; `is_usable` if it can be loaded."""

    def __init__(self, path: Path) -> None:
        self.is_usable = False
        facts: list[tuple[str, str]] = [("file", shown_path(path))]
        with suppress(WeightsError):
            data = read_once(path)
            facts.append(("size", f"{len(data) / 1e6:.1f} MB"))
            if path.suffix.lower() in (".pt", ".pth"):
                facts.extend(_of_pickle(pickled_facts(data)))
            elif path.suffix.lower() == ".safetensors":
                facts.append(("written by", "convert"))
            elif path.suffix.lower() == ".onnx":
                facts.append(("written by", "an export to ONNX"))
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


def _of_pickle(facts: PickledFacts) -> Iterator[tuple[str, str]]:
    yield "written by", f"YOLOv5 {facts.version}" if facts.version else ""
    yield "layers", facts.layers
    yield "activations", facts.activations
    yield "trained", facts.training


def _of_model(model: Model) -> Iterator[tuple[str, str]]:
    architecture = model.architecture
    with torch.device("meta"):
        network = Network(architecture)
    parameters = sum(parameter.numel() for parameter in network.parameters())
    activations = [type(module.act).__name__ for module in network.modules() if hasattr(module, "act")]
    yield "layers", counted(layer.kind for layer in architecture.layers)
    yield "activations", counted(activations)
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
