"""What the console knows of a detector, when its answers are late or its process was replaced."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import Any

import pytest
from rclpy.node import Node
from support.detector_process import NODE
from support.lone_node import lone_node
from support.preparations import Preparations
from support.served_node import PATIENCE_S, ServedNode

from yolov5_lifecycle.ros.console import detector
from yolov5_lifecycle.ros.console.detector import Detector
from yolov5_lifecycle.ros.console.ros_thread import RosThread
from yolov5_lifecycle.ros.console.views import LogView


class HeldDetector(Detector):
    """Takes an answer about parameters once `gate` is open; `is_answered`: one is on its way."""

    def __init__(self, ros: RosThread, **options: Any) -> None:
        super().__init__(ros, NODE, log=LogView(), publishers=frozenset(), **options)
        self.gate = asyncio.Event()
        self.gate.set()
        self.is_answered = asyncio.Event()

    async def _call(self, service: str, *request: Any) -> Any:
        answer = await super()._call(service, *request)
        if service == "get_parameters":
            self.is_answered.set()
            await self.gate.wait()
        return answer


class KnownDetector:
    """The console's view of `served`, which knows only what the test tells it and what it asks."""

    def __init__(self, served: ServedNode, ros: RosThread) -> None:
        self.served = served
        self._changed = asyncio.Event()
        self.detector = HeldDetector(ros, on_change=lambda _: self._changed.set())

    async def set(self, name: str, value: float) -> None:
        """Set the parameter in the node; the event that tells it does not arrive."""
        assert await asyncio.to_thread(lambda: self.served.set(**{name: value})) == (True, "")

    async def wait_for(self, condition: Callable[[], bool]) -> None:
        while not condition():
            self._changed.clear()
            await asyncio.wait_for(self._changed.wait(), PATIENCE_S)

    def value(self, name: str) -> object:
        """The value that the page shows, None if it shows none."""
        shown: Any = self.detector.as_json()["parameters"]
        return next((each["value"] for each in shown if each["name"] == name), None)


def play(served: ServedNode, act: Callable[[KnownDetector], Awaitable[None]]) -> None:
    """Let `act` use the detector in an event loop."""

    async def played(node: Node) -> None:
        ros = RosThread(node, asyncio.get_running_loop())
        ros.start()
        known = KnownDetector(served, ros)
        await known.detector.open()
        try:
            await act(known)
        finally:
            await known.detector.close()
            ros.stop()

    with lone_node("console") as node:
        asyncio.run(played(node))


def test_a_value_that_changes_while_parameters_are_queried_is_shown(
    served: ServedNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def act(known: KnownDetector) -> None:
        known.detector.gate.clear()
        await asyncio.wait_for(known.detector.is_answered.wait(), PATIENCE_S)
        await known.set("max_rate", 7.0)
        known.detector.ask_soon()
        known.detector.gate.set()
        await known.wait_for(lambda: known.value("max_rate") == 7.0)
        await known.set("max_rate", 8.0)  # its event is lost
        await known.wait_for(lambda: known.value("max_rate") == 8.0)

    monkeypatch.setattr(detector, "_REFRESH_S", 0.1)
    play(served, act)


def test_a_request_whose_detector_ends_is_answered_at_once(served: ServedNode, prepare: Preparations) -> None:
    async def act(known: KnownDetector) -> None:
        await known.wait_for(lambda: known.detector.state == "inactive")
        change = asyncio.create_task(known.detector.change_state("activate"))
        assert await asyncio.to_thread(prepare.begun.acquire, timeout=PATIENCE_S)
        await known.detector.close()
        reason = await asyncio.wait_for(change, PATIENCE_S)
        assert reason.startswith(f"{NODE}/change_state was lost before it answered; it may have done")
        assert await known.detector.set({"max_rate": 3.0}) == f"{NODE} is lost"
        assert await known.detector.change_state("shutdown") == ""
        assert await known.detector.collect() == (f"{NODE} is lost", "")

    served.bring_to("inactive")
    prepare.gate.clear()
    try:
        play(served, act)
    finally:
        prepare.gate.set()
