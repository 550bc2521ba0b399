"""Comparison of an exported graph with the steps of one of our networks, which finds the weights of each."""

from __future__ import annotations

from yolov5_lifecycle.checkpoints.graph_steps import GraphSteps, described, is_activation
from yolov5_lifecycle.checkpoints.network_steps import ACTIVATION, Step, same_settings
from yolov5_lifecycle.models.model import WeightsError, shown


class MatchedGraph:
    """What the values of a graph are in a network: names of arrays by key, activations by path.

    Both are complete once every output has been compared.
    """

    def __init__(self, steps: GraphSteps) -> None:
        self.arrays: dict[str, str] = {}
        self.activations: dict[str, str] = {}
        self._steps = steps
        self._seen: dict[int, str] = {}

    def compare(self, expected: Step, value: str) -> None:
        """Raise WeightsError unless `value` is computed from the pixels in the same steps as `expected`."""
        waiting = [(expected, value)]
        while waiting:
            step, made = waiting.pop()
            if id(step) not in self._seen:
                self._seen[id(step)] = made
                waiting.extend(self._compare_one(step, made))
            elif self._seen[id(step)] != made:
                raise WeightsError(f"the graph computes {described(step)} twice, in different ways")

    def _compare_one(self, expected: Step, value: str) -> list[tuple[Step, str]]:
        """The inputs of `expected`, each with the value that it has to be."""
        found = self._steps.of(value)
        if expected.kind == ACTIVATION:
            (path,) = expected.settings
            is_active = is_activation(found)
            self.activations[path] = found.kind if is_active else "Identity"
            return [(expected.inputs[0], found.inputs[0] if is_active else value)]
        if (found.kind, len(found.inputs), len(found.tensors)) != (
            expected.kind,
            len(expected.inputs),
            len(expected.tensors),
        ) or not same_settings(found.settings, expected.settings):
            raise WeightsError(
                f"the graph is no export of YOLOv5: {shown(value)} is made by {described(found)}, expected "
                f"{described(expected)}; use the .pt, or export that again"
            )
        self.arrays.update(zip(expected.tensors, found.tensors, strict=True))
        return list(zip(expected.inputs, found.inputs, strict=True))
