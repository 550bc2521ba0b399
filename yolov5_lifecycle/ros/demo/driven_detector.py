"""The detector, driven through its services step by step."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from yolov5_lifecycle.ros.demo.observer import Observer, RemoteLifecycleNode
from yolov5_lifecycle.ros.demo.outcome import DemonstrationError

DETECTOR = "/yolov5"


class DrivenDetector:
    """The managed node DETECTOR; calls `report` once per step.

    Its methods raise DemonstrationError for a refusal and NoAnswerError on a timeout.
    """

    def __init__(self, observer: Observer, *, report: Callable[[str], None]) -> None:
        self._node = RemoteLifecycleNode(observer, DETECTOR)
        self._report = report

    def wait_until_reachable(self) -> None:
        """Wait for the first response."""
        self._node.wait_until_reachable()

    def transition(self, label: str, goal: str) -> None:
        """Request the transition `label` and check that it leads to the state `goal`."""
        self._report(label)
        if not self._node.change_state(label):
            raise DemonstrationError(f"the detector refused to {label}; its log says why")
        if goal != "finalized":
            self.expect_state(goal)

    def expect_state(self, expected: str) -> None:
        """Check the lifecycle state."""
        state = self._node.state()
        if state != expected:
            raise DemonstrationError(f"expected the detector to be {expected}, but it is {state}")

    def set(self, **values: object) -> None:
        """Set parameters, all at once."""
        self._report("set " + ", ".join(f"{name}: {value}" for name, value in values.items()))
        refusal = self._node.set_parameters(**values)
        if refusal:
            raise DemonstrationError(f"setting {values} was refused: {refusal}")

    def parameter(self, name: str) -> Any:
        """Get the value of the parameter `name`, None if not set."""
        return self._node.parameter(name)
