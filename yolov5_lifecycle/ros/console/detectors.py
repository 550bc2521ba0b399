"""All detectors of the ROS graph that the console shows."""

from __future__ import annotations

import asyncio
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.msg import Log, ParameterEvent
from rclpy.exceptions import NameValidationException
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile

from yolov5_lifecycle.printable import in_one_line
from yolov5_lifecycle.ros.console.detector import SERVICES, Detector
from yolov5_lifecycle.ros.console.ros_thread import Mailbox, RosThread
from yolov5_lifecycle.ros.console.views import (
    LogLine,
    LogView,
    StatusView,
    line_of,
    node_name,
    statuses_of,
)

SCAN_S = 1.0
MAX_DETECTORS = 32
_MAX_LOGGERS = 64
"""Of which no detector is known yet: a node logs as it starts."""
_MAX_WAITING = 1000
_MAX_NAME = 300
_LOG_QOS = QoSProfile(depth=1000, durability=DurabilityPolicy.TRANSIENT_LOCAL)
"""The QoS of nodes' log publishers: late subscribers get the messages of the last seconds."""


@dataclass(eq=False)
class Detectors:
    """Finds detectors and keeps them up to date; `names`: full names of the wanted ones, empty: all.

    `on_change(detector)` is called after each change of a known one, `on_gone(detector)` when one has left
    the graph or is silent.
    """

    ros: RosThread
    names: Sequence[str]
    on_change: Callable[[Detector], object]
    on_gone: Callable[[Detector], object]

    def __post_init__(self) -> None:
        self._candidates: dict[str, frozenset[bytes]] = {}
        self._followed: dict[str, Detector] = {}
        self._logs: OrderedDict[str, LogView] = OrderedDict()
        """Of nodes that are not followed, by name."""
        self._diagnostics = Mailbox(self.ros, self._take_diagnostics, size=_MAX_WAITING)
        self._lines = Mailbox(self.ros, self._take_line, size=_MAX_WAITING)
        self._changed_names = Mailbox(self.ros, self._take_event, size=_MAX_WAITING)
        self._task: asyncio.Task[None] | None = None

    async def open(self) -> None:
        await self.ros.run(self._subscribe, self.ros.node)
        self._task = asyncio.create_task(self._follow())

    @property
    def known(self) -> list[Detector]:
        """Those that are shown, by name."""
        return [self._followed[name] for name in sorted(self._followed) if self._followed[name].is_known]

    def find(self, name: object) -> Detector | None:
        """The detector called `name`, if it is shown."""
        return next((detector for detector in self.known if detector.name == name), None)

    async def _follow(self) -> None:
        while True:
            self._candidates = await self.ros.run(candidates, self.ros.node, self.names)
            await self._update()
            await asyncio.sleep(SCAN_S)

    async def _update(self) -> None:
        """Adapt those that are followed to the candidates; those that are followed stay."""
        for detector in list(self._followed.values()):
            found = self._candidates.get(detector.name, frozenset())
            # A new publisher means a new process, which may come before the end of the old one is noticed.
            if not found or found - detector.publishers or detector.is_silent:
                await self._forget(detector)
            else:
                detector.publishers = found
        waiting = [name for name in self._candidates if name not in self._followed]
        room = MAX_DETECTORS - len(self._followed)
        for name in waiting[:room]:
            await self._begin(name)
        if waiting[room:]:
            self.ros.node.get_logger().warning(
                f"{len(waiting[room:])} further nodes are left out, {waiting[room]} first, as the console "
                f"shows at most {MAX_DETECTORS}: to see one, start a console with --node and its name",
                once=True,
            )

    async def _begin(self, name: str) -> None:
        log = self._logs.pop(name, LogView())
        detector = Detector(self.ros, name, self._changed, log, self._candidates[name])
        self._followed[name] = detector
        try:
            await detector.open()
        except NameValidationException as error:
            self.ros.node.get_logger().warning(f"{name} cannot be shown: {error}")

    async def _forget(self, detector: Detector) -> None:
        del self._followed[detector.name]
        self._logs[detector.name] = detector.log
        if detector.is_known:
            self.on_gone(detector)
        await detector.close()

    def _changed(self, detector: Detector) -> None:
        if detector.is_known and self._followed.get(detector.name) is detector:
            self.on_change(detector)

    def _subscribe(self, node: Node) -> None:
        node.create_subscription(DiagnosticArray, "/diagnostics", self._hear_diagnostics, 100)
        node.create_subscription(Log, "/rosout", self._hear_log, _LOG_QOS)
        node.create_subscription(ParameterEvent, "/parameter_events", self._hear_event, 100)

    def _hear_diagnostics(self, message: DiagnosticArray) -> None:
        name = message.status[0].hardware_id if message.status else ""
        if name in self._candidates:
            self._diagnostics.put((name, statuses_of(message)))

    def _hear_log(self, message: Log) -> None:
        self._lines.put((node_name(in_one_line(message.name, _MAX_NAME)), line_of(message)))

    def _hear_event(self, message: ParameterEvent) -> None:
        if message.node in self._candidates:
            self._changed_names.put(message.node)

    def _take_diagnostics(self, news: tuple[str, list[StatusView]]) -> None:
        name, statuses = news
        if name in self._followed:
            self._followed[name].take_diagnostics(statuses)

    def _take_line(self, news: tuple[str, LogLine]) -> None:
        name, line = news
        if detector := self._followed.get(name):
            detector.log.add(line)
            self._changed(detector)
        else:
            self._logs.setdefault(name, LogView()).add(line)
            self._logs.move_to_end(name)
            if len(self._logs) > _MAX_LOGGERS:
                self._logs.popitem(last=False)

    def _take_event(self, name: str) -> None:
        if name in self._followed:
            self._followed[name].ask_soon()


def candidates(node: Node, names: Sequence[str]) -> dict[str, frozenset[bytes]]:
    """The nodes that look like detectors to `node`, by name, with their publishers of diagnostics.

    They have a detector's services. `names`: full names of the wanted ones; empty: all.
    """
    publishers: dict[str, set[bytes]] = {}
    for endpoint in node.get_publishers_info_by_topic("/diagnostics"):
        name = f"{endpoint.node_namespace.rstrip('/')}/{endpoint.node_name}"
        publishers.setdefault(name, set()).add(bytes(endpoint.endpoint_gid))
    services = {name for name, _ in node.get_service_names_and_types()}
    return {
        name: frozenset(found)
        for name, found in sorted(publishers.items())
        if (name in names or not names) and services.issuperset(f"{name}/{each}" for each in SERVICES)
    }
