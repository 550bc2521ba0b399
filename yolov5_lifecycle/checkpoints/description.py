"""Description of a weights file for its user."""

from __future__ import annotations

import textwrap
from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path

from yolov5_lifecycle.checkpoints.locate import load_weights, shown_path
from yolov5_lifecycle.models.cost import size_multiple, usual_cost
from yolov5_lifecycle.models.model import Export, Model, WeightsError, blueprint
from yolov5_lifecycle.printable import in_one_line

_LABEL = 14
_WIDTH = 100
_MAX_LINES = 3
_MAX_KINDS = 12


def description(path: Path) -> tuple[str, bool]:
    """What the file at `path` holds, a fact per line, which fit on a screen; and whether it can be loaded."""
    facts: list[tuple[str, str]] = [("file", shown_path(path))]
    with suppress(OSError, ValueError):
        facts.append(("size", f"{path.stat().st_size / 1e6:.1f} MB"))
    is_usable = False
    try:
        weights = load_weights(path)
        content = weights.content
        facts += _of_export(content) if isinstance(content, Export) else _of_model(content)
        facts += [("sha256", weights.sha256), ("usable", "yes")]
        is_usable = True
    except WeightsError as refusal:
        reason = str(refusal).removeprefix(f"{shown_path(path)}: ")
        facts.append(("usable", f"no: {reason}"))
    return "".join(_lines(label, value) for label, value in facts), is_usable


def _of_model(model: Model) -> Iterator[tuple[str, str]]:
    architecture = model.architecture
    network = blueprint(architecture)
    parameters = sum(parameter.numel() for parameter in network.parameters())
    yield "layers", _counted(layer.kind for layer in architecture.layers)
    yield (
        "activations",
        _counted(type(module.act).__name__ for module in network.modules() if hasattr(module, "act")),
    )
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
    if export.mask_coefficients:
        yield "masks", f"{export.mask_coefficients} prototypes"
    yield "classes", f"{len(export.class_names)}: {', '.join(export.class_names)}"


def _colours(channels: int) -> str:
    return "grey" if channels == 1 else "colour"


def _lines(label: str, value: str) -> str:
    """A fact in at most a few lines."""
    room = _WIDTH - _LABEL
    lines = textwrap.wrap(in_one_line(value, room * _MAX_LINES - 40), room) or [""]
    blank = " " * _LABEL
    return f"{label:<{_LABEL}}" + f"\n{blank}".join(lines) + "\n"


def _counted(kinds: Iterable[str]) -> str:
    """Such as "8 C3, 7 Conv, 1 SPPF", the most frequent first."""
    return ", ".join(f"{count} {kind}" for kind, count in Counter(kinds).most_common(_MAX_KINDS))
