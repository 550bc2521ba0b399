"""Topics on which all nodes send: diagnostics, log and parameter events."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress

from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.msg import Log, ParameterEvent
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile

from yolov5_lifecycle.ros.console.budget import Budget, Budgets
from yolov5_lifecycle.ros.console.camera_view import StatusView, read_statuses
from yolov5_lifecycle.ros.console.log_view import LogLine, read_log
from yolov5_lifecycle.ros.console.ros_thread import RosThread
from yolov5_lifecycle.ros.console.serialized_message import SerializedMessage, UnreadableError

MAX_NAME = 300
"""Characters; ROS allows 255 for a name."""
_QOS = QoSProfile(depth=100)
_LOG_QOS = QoSProfile(depth=1000, durability=DurabilityPolicy.TRANSIENT_LOCAL)
"""The QoS of nodes' log publishers: late subscribers get the messages of the last seconds."""
_LINES_PER_S, _LINES = 100.0, 1000
"""Of one logger."""
_DIAGNOSTICS_PER_S, _DIAGNOSTICS = 20.0, 40
"""Of one node, which usually sends one per second."""


class Broadcasts:
    """Passes on what nodes send, in the thread of the event loop.

    Anybody may send anything under any name. So messages are taken serialized, read no further than needed,
    and what one name sends too often is dropped, before it reaches the event loop. `is_wanted(name)`, called
    in the thread of ROS, tells whether a node is of interest; the log is taken of all.

    `on_parameters(name)`: a parameter of that node may have changed; `on_diagnostics(name, statuses)`;
    `on_log(logger_name, line)`.
    """

    def __init__(
        self,
        ros: RosThread,
        is_wanted: Callable[[str], bool],
        *,
        on_parameters: Callable[[str], object],
        on_diagnostics: Callable[[str, list[StatusView]], object],
        on_log: Callable[[str, LogLine], object],
    ) -> None:
        self._ros = ros
        self._is_wanted = is_wanted
        self._on_parameters = on_parameters
        self._on_diagnostics = on_diagnostics
        self._on_log = on_log
        self._hinted: set[str] = set()
        self._diagnostics = Budgets(lambda: Budget(_DIAGNOSTICS_PER_S, _DIAGNOSTICS))
        self._lines = Budgets(lambda: Budget(_LINES_PER_S, _LINES))

    async def open(self) -> None:
        """Subscribe."""
        await self._ros.run(self._subscribe, self._ros.node)

    def _subscribe(self, node: Node) -> None:
        for kind, topic, hear, qos in (
            (DiagnosticArray, "/diagnostics", self._hear_diagnostics, _QOS),
            (Log, "/rosout", self._hear_log, _LOG_QOS),
            (ParameterEvent, "/parameter_events", self._hear_event, _QOS),
        ):
            node.create_subscription(kind, topic, _unless_unreadable(hear), qos, raw=True)

    def _hear_event(self, content: bytes) -> None:
        message = SerializedMessage(content)
        message.time_s()
        name = message.text(MAX_NAME)
        if name not in self._hinted and self._is_wanted(name):
            self._hinted.add(name)
            self._ros.post(self._take_hint, name)

    def _take_hint(self, name: str) -> None:
        self._hinted.discard(name)
        self._on_parameters(name)

    def _hear_diagnostics(self, content: bytes) -> None:
        statuses = read_statuses(content)
        name, first = next(statuses, ("", None))
        if first is not None and self._is_wanted(name) and self._diagnostics.of(name).spend():
            others = [status for other, status in statuses if other == name]
            self._ros.post(self._on_diagnostics, name, [first, *others])

    def _hear_log(self, content: bytes) -> None:
        logger, line = read_log(content)
        if self._lines.of(logger).spend():
            self._ros.post(self._on_log, logger, line)


def _unless_unreadable(hear: Callable[[bytes], None]) -> Callable[[bytes], None]:
    def heard(content: bytes) -> None:
        with suppress(UnreadableError):  # then it is none of this type, whatever its sender says
            hear(content)

    return heard
