"""The kinds of layers whose exports are read, and their arguments, from the convolutions of a layer."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

from yolov5_lifecycle.checkpoints.graph_steps import GraphSteps
from yolov5_lifecycle.checkpoints.network_steps import Step
from yolov5_lifecycle.models.model import WeightsError, shown

WITHOUT_WEIGHTS = ("concat", "upsample", "max-pool", "pad")


@dataclass(frozen=True)
class Convolution:
    """A convolution of the graph: the value that it reads, and the one that its activation makes."""

    step: Step
    shape: tuple[int, ...]
    made: str

    @property
    def reads(self) -> str:
        value: str = self.step.inputs[0]
        return value

    @property
    def channels_out(self) -> int:
        return self.shape[0]

    @property
    def kernel_hw(self) -> tuple[int, ...]:
        return self.shape[2:]


Parts = Mapping[str, Convolution]
"""The convolutions of a layer by their paths in it."""


@dataclass
class ExportedLayer:
    """A layer: its row without sources, the values that it reads and the one that it makes."""

    kind: str
    arguments: list[Any]
    reads: tuple[str, ...]
    made: str
    repeats: int = 1


def exported_layer(steps: GraphSteps, parts: Parts, index: int) -> ExportedLayer:
    """The layer with the convolutions `parts`; raises WeightsError for one that is not supported."""
    repeated = {path.partition(".")[0] for path in parts}
    if all(number.isdecimal() for number in repeated):
        return _sequence(steps, parts, index)
    for needed, make in _KINDS.items():
        if needed <= parts.keys() and (layer := make(steps, parts)):
            return layer
    raise WeightsError(
        f"layer {index} has the weights {shown(sorted(parts))}: exports of such a layer are not read; "
        "use the .pt"
    )


def _sequence(steps: GraphSteps, parts: Parts, index: int) -> ExportedLayer:
    """A layer that is repeated as a whole."""
    blocks: dict[str, dict[str, Convolution]] = {}
    for path, part in parts.items():
        number, _, rest = path.partition(".")
        blocks.setdefault(number, {})[rest] = part
    layers = [exported_layer(steps, blocks[number], index) for number in sorted(blocks, key=int)]
    first = layers[0]
    return ExportedLayer(first.kind, first.arguments, first.reads, layers[-1].made, len(layers))


def _conv(steps: GraphSteps, parts: Parts) -> ExportedLayer | None:
    conv = parts["conv"]
    stride, padding, dilation, groups = conv.step.settings
    sides = [*conv.kernel_hw, *stride, *padding, *dilation]
    if len(sides) != 10 or sides != [sides[0]] * 2 + [sides[2]] * 2 + [sides[4]] * 4 + [sides[8]] * 2:
        return None
    arguments = [conv.channels_out, sides[0], sides[2], sides[4], groups, sides[8]]
    return ExportedLayer("Conv", arguments, (conv.reads,), conv.made)


def _focus(steps: GraphSteps, parts: Parts) -> ExportedLayer:
    conv = parts["conv.conv"]
    return ExportedLayer("Focus", [conv.channels_out, conv.kernel_hw[0]], (steps.graph.pixels,), conv.made)


def _c3(steps: GraphSteps, parts: Parts) -> ExportedLayer | None:
    return _partial(steps, parts, "cv3.conv", "C3", "C3x")


def _cross_stage(steps: GraphSteps, parts: Parts) -> ExportedLayer | None:
    return _partial(steps, parts, "cv4.conv", "BottleneckCSP", "CrossCSP")


def _partial(steps: GraphSteps, parts: Parts, last: str, kind: str, crossed: str) -> ExportedLayer | None:
    inner = [path for path in parts if path.startswith("m.")]
    count = sum(path.endswith(".cv1.conv") for path in inner)
    if "m.0.cv1.conv" not in parts or "m.0.cv2.conv" not in parts or len(inner) != 2 * count:
        return None
    first, second, channels = parts["m.0.cv1.conv"], parts["m.0.cv2.conv"], parts[last].channels_out
    arguments = [
        channels,
        _adds(steps, first.reads, second.made) is not None,
        second.step.settings[-1],
        _expansion(parts["cv1.conv"].channels_out, channels),
    ]
    kind = kind if first.kernel_hw == (1, 1) else crossed
    return ExportedLayer(kind, arguments, (parts["cv1.conv"].reads,), parts[last].made, count)


def _expansion(hidden: int, channels: int) -> float:
    """One of which the whole part of the product with `channels` is `hidden`."""
    return 0.5 if hidden == channels // 2 else (hidden + 0.25) / channels


def _adds(steps: GraphSteps, before: str, after: str) -> str | None:
    """The sum of two values."""
    for node in steps.graph.readers.get(after, []):
        step = steps.of(node.outputs[0]) if node.outputs else Step("")
        if step.kind == "add" and step.inputs == (before, after):
            return node.outputs[0]
    return None


def _pyramid_or_bottleneck(steps: GraphSteps, parts: Parts) -> ExportedLayer | None:
    first, second = parts["cv1.conv"], parts["cv2.conv"]
    if len(parts) != 2:
        return None
    joined = steps.of(second.reads)
    if joined.kind == "concat" and joined.inputs[0] == first.made:
        return _pyramid(steps, first, second, joined)
    if second.reads != first.made or first.kernel_hw != (1, 1):
        return None
    added = _adds(steps, first.reads, second.made)
    arguments = [
        second.channels_out,
        added is not None,
        second.step.settings[-1],
        _expansion(first.channels_out, second.channels_out),
    ]
    return ExportedLayer("Bottleneck", arguments, (first.reads,), added or second.made)


def _pyramid(
    steps: GraphSteps, first: Convolution, second: Convolution, joined: Step
) -> ExportedLayer | None:
    pools = [steps.of(value) for value in joined.inputs[1:]]
    if any(pool.kind != "max-pool" for pool in pools):
        return None
    windows = [pool.settings[0] for pool in pools]
    producer = steps.graph.producers[joined.inputs[-1]]
    is_chain = len(windows) == 3 and producer.inputs[0] == joined.inputs[-2]
    kind, argument = ("SPPF", windows[0]) if is_chain else ("SPP", windows)
    return ExportedLayer(kind, [second.channels_out, argument], (first.reads,), second.made)


_KINDS: Mapping[frozenset[str], Callable[[GraphSteps, Parts], ExportedLayer | None]] = MappingProxyType(
    {
        frozenset({"conv"}): _conv,
        frozenset({"conv.conv"}): _focus,
        frozenset({"cv1.conv", "cv2.conv", "cv3.conv"}): _c3,
        frozenset({"cv1.conv", "cv2", "cv3", "cv4.conv"}): _cross_stage,
        frozenset({"cv1.conv", "cv2.conv"}): _pyramid_or_bottleneck,
    }
)
"""By the convolutions that a layer of the kind has."""


def layer_without_weights(step: Step, value: str) -> ExportedLayer:
    """The layer of a step of one of the kinds `WITHOUT_WEIGHTS`, which makes `value`."""
    if step.kind == "max-pool":
        return ExportedLayer("MaxPool2d", list(step.settings), step.inputs, value)
    if step.kind == "pad":
        return ExportedLayer("ZeroPad2d", [list(step.settings[0])], step.inputs, value)
    if step.kind == "upsample":
        return ExportedLayer("Upsample", [None, 2, "nearest"], step.inputs, value)
    return ExportedLayer("Concat", [1], step.inputs, value)
