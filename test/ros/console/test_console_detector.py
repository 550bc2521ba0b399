"""What the console knows of a detector, when its answers are late, an event is lost or its process ends."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import Any

import pytest
from rclpy.node import Node
from support.detector_process import NODE
from support.lone_node import lone_node
from support.preparations import Preparations
from support.served_node import ServedNode

from yolov5_lifecycle.ros.console import detector
from yolov5_lifecycle.ros.console.detector import Detector
from yolov5_lifecycle.ros.console.ros_thread import RosThread
from yolov5_lifecycle.ros.console.views import LogView
from yolov5_lifecycle.ros.observer import PATIENCE_S


class KnownDetector:
    """The console's view of a detector, which knows only what it asks: no event tells it anything."""

    def __init__(self, ros: RosThread) -> None:
        self._changed = asyncio.Event()
        self.detector = Detector(ros, NODE, lambda _: self._changed.set(), LogView(), frozenset())

    async def wait_for(self, condition: Callable[[], bool]) -> None:
        while not condition():
            self._changed.clear()
            await asyncio.wait_for(self._changed.wait(), PATIENCE_S)

    def value(self, name: str) -> object:
        """The value that the page shows, None if it shows none."""
        shown: Any = self.detector.as_json()["parameters"]
        return next((each["value"] for each in shown if each["name"] == name), None)


def play(act: Callable[[KnownDetector], Awaitable[None]]) -> None:
    """Let `act` use the detector in an event loop."""

    async def played(node: Node) -> None:
        ros = RosThread(node, asyncio.get_running_loop())
        ros.start()
        known = KnownDetector(ros)
        await known.detector.open()
        try:
            await act(known)
        finally:
            await known.detector.close()
            ros.stop()

    with lone_node("console") as node:
        asyncio.run(played(node))


def test_a_value_whose_event_is_lost_is_shown_after_a_while(
    served: ServedNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def act(known: KnownDetector) -> None:
        await known.wait_for(lambda: known.value("max_rate") == 0.0)
        assert await asyncio.to_thread(lambda: served.set(max_rate=8.0)) == (True, "")
        await known.wait_for(lambda: known.value("max_rate") == 8.0)

    monkeypatch.setattr(detector, "_REFRESH_S", 0.1)
    play(act)


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
        play(act)
    finally:
        prepare.gate.set()
