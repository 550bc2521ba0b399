"""The operations of an exported graph as the steps of a network."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from types import MappingProxyType

from yolov5_lifecycle.checkpoints.network_steps import PIXELS, Step, pooled, sliced
from yolov5_lifecycle.checkpoints.onnx_graph import Graph, Node
from yolov5_lifecycle.models.activations import leaky_relu
from yolov5_lifecycle.models.model import shown

FOREIGN = "foreign"
_MAX_NUMBERS = 64
"""In an array that an operation reads as settings."""
_END = 1 << 30  # slices to the end are written with a number that no image has as size
_CONV_DEFAULTS: Mapping[str, tuple[int, ...]] = MappingProxyType(
    {"strides": (1, 1), "pads": (0, 0, 0, 0), "dilations": (1, 1)}
)


class GraphSteps:
    """Steps by the names of the values in `graph` that they make.

    A value of an operation that no network here has is made by a step of the kind FOREIGN.
    """

    def __init__(self, graph: Graph) -> None:
        self.graph = graph
        self._steps = {graph.pixels: Step(PIXELS)}
        for node in graph.nodes:  # in order of execution, so inputs come first
            self._steps.update(dict.fromkeys(node.outputs[:1], self._step(node)))

    def of(self, value: str) -> Step:
        return self._steps.get(value, Step(FOREIGN, (value,)))

    def _step(self, node: Node) -> Step:
        arity, make = _STEPS.get(node.operator, (range(0), _foreign))
        found = make(self, node) if len(node.inputs) in arity else None
        return found or _foreign(self, node)

    def numbers(self, value: str) -> list[float]:
        """The numbers of a small array, or of two that are joined; none for any other value."""
        joined = self.made_by(value, "Concat")
        if joined and len(joined.inputs) == 2 and all(map(self.is_array, joined.inputs)):
            return [number for part in joined.inputs for number in self.numbers(part)]
        array = self.graph.arrays.get(value)
        return array.numbers().ravel().tolist() if array and array.elements <= _MAX_NUMBERS else []

    def whole_numbers(self, value: str) -> list[int]:
        """Those of a small array of integers; none for other arrays."""
        return [number for number in self.numbers(value) if isinstance(number, int)]

    def made_by(self, value: str, operator: str) -> Node | None:
        node = self.graph.producers.get(value)
        return node if node is not None and node.operator == operator else None

    def is_array(self, value: str) -> bool:
        return value in self.graph.arrays


def _foreign(steps: GraphSteps, node: Node) -> Step:
    return Step(FOREIGN, (node.operator, node.name))


def _conv(steps: GraphSteps, node: Node) -> Step | None:
    values, *tensors = node.inputs
    if node.attributes.get("auto_pad", "NOTSET") != "NOTSET" or not all(map(steps.is_array, tensors)):
        return None
    kernel = steps.graph.arrays[tensors[0]].shape[2:]
    if node.integers("kernel_shape", kernel) != kernel:
        return None
    settings = [node.integers(name, default) for name, default in _CONV_DEFAULTS.items()]
    return Step("conv", (*settings, node.attributes.get("group", 1)), (values,), tuple(filter(None, tensors)))


def _normalisation(steps: GraphSteps, node: Node) -> Step | None:
    values, *tensors = node.inputs
    if not all(map(steps.is_array, tensors)) or node.attributes.get("training_mode", 0):
        return None
    return Step("normalisation", (node.attributes.get("epsilon", 1e-5),), (values,), tuple(tensors))


def _max_pool(steps: GraphSteps, node: Node) -> Step | None:
    sides = (
        *node.integers("kernel_shape"),
        *node.integers("strides", (1, 1)),
        *node.integers("pads", (0, 0, 0, 0)),
    )
    usual = {"auto_pad": "NOTSET", "ceil_mode": 0, "storage_order": 0, "dilations": (1, 1)}
    is_usual = all(node.attributes.get(name, value) == value for name, value in usual.items())
    if len(sides) != 8 or sides != (*sides[:1] * 2, *sides[2:3] * 2, *sides[4:5] * 4) or not is_usual:
        return None
    return pooled(steps.of(node.inputs[0]), node.inputs[0], sides[0], sides[2], sides[4])


def _concat(steps: GraphSteps, node: Node) -> Step | None:
    if node.attributes.get("axis") not in (1, -3) or any(map(steps.is_array, node.inputs)):
        return None
    return Step("concat", (), node.inputs)


def _add(steps: GraphSteps, node: Node) -> Step | None:
    return None if any(map(steps.is_array, node.inputs)) else Step("add", (), node.inputs)


def _upsample(steps: GraphSteps, node: Node) -> Step | None:
    """Sizes instead of scales are not checked: only twice the size fits what reads the output."""
    is_nearest = node.attributes.get("mode", "nearest") == "nearest"
    rounding = node.attributes.get("nearest_mode", "floor")
    places = node.attributes.get("coordinate_transformation_mode", "asymmetric")
    if not is_nearest or rounding != "floor" or places != "asymmetric":
        return None
    scales = steps.numbers(node.inputs[2] if len(node.inputs) > 2 else node.inputs[-1])
    has_sizes = len(node.inputs) == 4 and not scales
    return Step("upsample", (), node.inputs[:1]) if has_sizes or scales == [1, 1, 2, 2] else None


def _slice(steps: GraphSteps, node: Node) -> Step | None:
    starts, ends, axes, strides = map(steps.whole_numbers, node.inputs[1:])
    if not len(starts) == len(ends) == len(axes) == len(strides) or min(ends, default=0) < _END:
        return None
    slices = {axis % 4: (start, by) for axis, start, by in zip(axes, starts, strides, strict=True)}
    return sliced(steps.of(node.inputs[0]), node.inputs[0], slices)


def _pad(steps: GraphSteps, node: Node) -> Step | None:
    sides = steps.whole_numbers(node.inputs[1])
    values = steps.numbers(node.inputs[2]) if len(node.inputs) > 2 and node.inputs[2] else [0]
    is_zero = node.attributes.get("mode", "constant") == "constant" and values == [0]
    if not is_zero or len(sides) != 8 or any(sides[:2] + sides[4:6]):
        return None
    _, _, top, left, _, _, bottom, right = sides
    return Step("pad", ((left, right, top, bottom),), node.inputs[:1])


def _product(steps: GraphSteps, node: Node) -> Step | None:
    """SiLU and Hardswish are a product of features with a function of them."""
    for features, factor in (node.inputs, node.inputs[::-1]):
        if (gate := steps.made_by(factor, "Sigmoid")) and gate.inputs == (features,):
            return Step("SiLU", (), (features,))
        gate = steps.made_by(factor, "HardSigmoid")
        if gate and gate.inputs == (features,) and _is_hard(gate):
            return Step("Hardswish", (), (features,))
        if _is_clipped(steps, factor, features):
            return Step("six times Hardswish", (), (features,))
        divided = steps.made_by(factor, "Div")
        if (
            divided
            and _is_number(steps, divided.inputs[1], 6)
            and _is_clipped(steps, divided.inputs[0], features)
        ):
            return Step("Hardswish", (), (features,))
    return None


def _quotient(steps: GraphSteps, node: Node) -> Step | None:
    product = steps.of(node.inputs[0])
    is_hard = product.kind == "six times Hardswish" and _is_number(steps, node.inputs[1], 6)
    return Step("Hardswish", (), product.inputs) if is_hard else None


def _is_hard(gate: Node) -> bool:
    slope, offset = gate.attributes.get("alpha", 0.2), gate.attributes.get("beta", 0.5)
    return offset == 0.5 and isinstance(slope, float) and math.isclose(slope, 1 / 6, rel_tol=1e-3)


def _is_clipped(steps: GraphSteps, value: str, features: str) -> bool:
    """Whether `value` is `features` plus 3, within 0 and 6."""
    clip = steps.made_by(value, "Clip")
    if clip is None or len(clip.inputs) != 3:
        return False
    shifted = steps.made_by(clip.inputs[0], "Add")
    return (
        shifted is not None
        and shifted.inputs[0] == features
        and _is_number(steps, shifted.inputs[1], 3)
        and _is_number(steps, clip.inputs[1], 0)
        and _is_number(steps, clip.inputs[2], 6)
    )


def _is_number(steps: GraphSteps, value: str, expected: float) -> bool:
    return steps.numbers(value) == [expected]


def _leaky(steps: GraphSteps, node: Node) -> Step | None:
    slope = node.attributes.get("alpha", 0.01)
    if not isinstance(slope, float) or not 0 <= slope <= 1:
        return None
    return Step(leaky_relu(float(f"{slope:.6g}")), (), node.inputs)  # a file holds it in single precision


_STEPS: Mapping[str, tuple[range, Callable[[GraphSteps, Node], Step | None]]] = MappingProxyType(
    {
        "Conv": (range(2, 4), _conv),
        "BatchNormalization": (range(5, 6), _normalisation),
        "MaxPool": (range(1, 2), _max_pool),
        "Concat": (range(1, 17), _concat),
        "Add": (range(2, 3), _add),
        "Resize": (range(2, 5), _upsample),
        "Upsample": (range(2, 3), _upsample),
        "Slice": (range(5, 6), _slice),
        "Pad": (range(2, 4), _pad),
        "Mul": (range(2, 3), _product),
        "Div": (range(2, 3), _quotient),
        "LeakyRelu": (range(1, 2), _leaky),
        "Relu": (range(1, 2), lambda steps, node: Step("ReLU", (), node.inputs)),
        "HardSwish": (range(1, 2), lambda steps, node: Step("Hardswish", (), node.inputs)),
    }
)
"""By operator: how many inputs it has, and what makes its step; None if no network has its settings."""
ACTIVATION_KINDS = ("SiLU", "Hardswish", "ReLU")


def is_activation(step: Step) -> bool:
    return step.kind in ACTIVATION_KINDS or step.kind.startswith("LeakyReLU(")


def described(step: Step) -> str:
    """Such as "a conv of 'model.0.conv.weight'", for messages."""
    if step.kind == FOREIGN:
        return f"an operation {shown(step.settings[0])}"
    return f"a {step.kind}" + (f" of {shown(step.tensors[0])}" if step.tensors else "")
