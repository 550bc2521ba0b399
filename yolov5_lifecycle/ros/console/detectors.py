"""All detectors of the ROS graph that the console shows."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterable
from contextlib import suppress
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.msg import Log, ParameterEvent
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile

from yolov5_lifecycle.ros.console.camera_view import StatusView
from yolov5_lifecycle.ros.console.detector import Detector
from yolov5_lifecycle.ros.console.detector_link import DetectorLink
from yolov5_lifecycle.ros.console.graph import Candidate, candidates
from yolov5_lifecycle.ros.console.log_view import LogLine, logger_name
from yolov5_lifecycle.ros.console.ros_thread import RosThread

SCAN_S = 1.0
_MAX_DETECTORS = 32
_LOG_QOS = QoSProfile(depth=1000, durability=DurabilityPolicy.TRANSIENT_LOCAL)
"""The QoS of nodes' log publishers: late subscribers get the messages of the last seconds."""


class Detectors:
    """Finds detectors and keeps them up to date; `names`: full names of the wanted ones, empty: all.

    `on_change(detector)` is called after each change of a known one, `on_gone(name)` when one has left the
    graph or is silent.
    """

    def __init__(
        self,
        ros: RosThread,
        names: tuple[str, ...],
        *,
        on_change: Callable[[Detector], object],
        on_gone: Callable[[str], object],
    ) -> None:
        self._ros = ros
        self._names = names
        self._on_change = on_change
        self._on_gone = on_gone
        self._followed: dict[str, Detector] = {}
        self._shown: set[str] = set()
        self._unconfirmed: set[str] = set()  # hidden until a scan tells whether they were restarted
        self._by_logger: dict[str, str] = {}
        self._task: asyncio.Task[None] | None = None

    async def open(self) -> None:
        await self._ros.run(self._subscribe, self._ros.node)
        self._task = asyncio.create_task(self._follow())

    async def close(self) -> None:
        if self._task is not None:
            self._task.cancel()
            with suppress(asyncio.CancelledError):
                await self._task

    @property
    def known(self) -> list[Detector]:
        """Those that are shown, by name."""
        return [self._followed[name] for name in sorted(self._shown)]

    def find(self, name: object) -> Detector | None:
        """The detector called `name`, if it is shown."""
        return self._followed[name] if isinstance(name, str) and name in self._shown else None

    async def _follow(self) -> None:
        while True:
            were_silent = (self._followed[name] for name in self._unconfirmed)
            returned = [detector for detector in were_silent if not detector.is_silent]
            found = await self._ros.run(candidates, self._ros.node, self._names)
            await self._update(found[:_MAX_DETECTORS])
            self._show_again(returned)
            await asyncio.sleep(SCAN_S)

    async def _update(self, found: Iterable[Candidate]) -> None:
        present = {candidate.name: candidate for candidate in found}
        for name, detector in list(self._followed.items()):
            if name not in present or present[name].publishers - detector.publishers:
                await self._forget(detector)
            elif detector.is_silent and name in self._shown:
                detector.invalidate()
                self._hide(name)
                self._unconfirmed.add(name)
        for name, candidate in present.items():
            if name not in self._followed:
                link = DetectorLink(self._ros, name)
                detector = Detector(link, candidate.publishers, on_change=self._changed)
                self._followed[name] = detector
                self._by_logger[logger_name(name)] = name
                await detector.open()

    def _show_again(self, returned: Iterable[Detector]) -> None:
        """Show those whose process is still the one that was silent; the others have been forgotten."""
        for detector in returned:
            if self._followed.get(detector.name) is detector:
                self._unconfirmed.discard(detector.name)
                self._changed(detector)

    async def _forget(self, detector: Detector) -> None:
        self._hide(detector.name)
        self._unconfirmed.discard(detector.name)
        del self._followed[detector.name]
        del self._by_logger[logger_name(detector.name)]
        await detector.close()

    def _hide(self, name: str) -> None:
        if name in self._shown:
            self._shown.remove(name)
            self._on_gone(name)

    def _changed(self, detector: Detector) -> None:
        is_current = self._followed.get(detector.name) is detector and detector.name not in self._unconfirmed
        if not is_current or not detector.is_known or detector.is_silent:
            return
        self._shown.add(detector.name)
        self._on_change(detector)

    def _subscribe(self, node: Node) -> None:
        def post(take: Callable[[Any], object]) -> Callable[[Any], None]:
            return lambda message: self._ros.post(take, message)

        events = QoSProfile(depth=1000)
        node.create_subscription(DiagnosticArray, "/diagnostics", post(self._take_diagnostics), 10)
        node.create_subscription(Log, "/rosout", post(self._take_log), _LOG_QOS)
        node.create_subscription(ParameterEvent, "/parameter_events", post(self._take_event), events)

    def _take_diagnostics(self, message: DiagnosticArray) -> None:
        by_node: dict[str, list[StatusView]] = {}
        for status in message.status:
            if status.hardware_id in self._followed:
                by_node.setdefault(status.hardware_id, []).append(StatusView.of(status))
        for name, statuses in by_node.items():
            self._followed[name].take_diagnostics(statuses)

    def _take_log(self, message: Log) -> None:
        if name := self._by_logger.get(message.name):
            self._followed[name].take_log(LogLine.of(message))

    def _take_event(self, message: ParameterEvent) -> None:
        if message.node in self._followed:
            self._followed[message.node].take_parameter_event(message)
