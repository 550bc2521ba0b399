"""A detector as the console knows it: kept up to date by its messages, driven through its services."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass
from typing import Any

from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetAvailableTransitions, GetState
from rcl_interfaces.srv import GetParameters, ListParameters, SetParametersAtomically
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_srvs.srv import Trigger
from vision_msgs.msg import LabelInfo

from yolov5_lifecycle.printable import in_one_line
from yolov5_lifecycle.ros.console.ros_thread import Mailbox, RosThread
from yolov5_lifecycle.ros.console.views import (
    LogView,
    StatusView,
    camera_as_json,
    class_names_of,
    parameter_message,
    parameters_as_json,
)
from yolov5_lifecycle.ros.services import MAX_ITEMS
from yolov5_lifecycle.settings.camera_overrides import NODE_STATUS, usable_names
from yolov5_lifecycle.settings.settings import SCHEMA

_SILENCE_S = 5.0
"""A detector that sends no diagnostics (usually one per second) for longer than this is gone."""
SERVICES = {
    "get_state": GetState,
    "get_available_transitions": GetAvailableTransitions,
    "change_state": ChangeState,
    "list_parameters": ListParameters,
    "get_parameters": GetParameters,
    "set_parameters_atomically": SetParametersAtomically,
    "collect": Trigger,
}
_REFRESH_S = 5.0
"""The node is asked again after this time, in case that a message about a change was lost or false."""
_ASK_S = 3.0
"""Timeout of what a node answers at once, such as a query, which is then repeated."""
_ACT_S = 300.0
"""Timeout of a transition or change, which may load a model on a slow machine."""
_PACE_S = 0.1
"""Pause between two queries, however many messages tell of changes."""
_RETRY_S = 0.5
_REASON_S = 1.5
"""How long to watch the log for the reason of a refusal, which is not in the response."""
_MAX_TRANSITIONS, _MAX_LABEL, _MAX_WORDS = 30, 100, 5_000
_NO_REASON = "the node gave no reason"
_LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


@dataclass(eq=False)
class Detector:
    """The detector called `name`, for the event loop's thread; `on_change(self)` after each change.

    Messages of topics only tell that something may have changed, as anybody can send them: what is shown of
    state and parameters are answers of the node's services.

    `log`: its lines, also those from before it was known; `publishers`: ids of its publishers of diagnostics.
    """

    ros: RosThread
    name: str
    on_change: Callable[[Detector], object]
    log: LogView
    publishers: frozenset[bytes]

    def __post_init__(self) -> None:
        self.state = ""
        self.statuses: dict[str, StatusView] = {}
        """The last diagnostics by name."""
        self._clients: dict[str, Any] = {}
        self._labels: Any = None
        self._end: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._transitions: list[str] = []
        self._parameters: dict[str, dict[str, object]] = {}
        self._class_names: list[str] = []
        self._wanted = asyncio.Event()
        self._heard_s: float | None = None
        self._task: asyncio.Task[None] | None = None

    async def open(self) -> None:
        """Start querying the node."""
        await self.ros.run(self._create)
        self._task = asyncio.create_task(self._keep_up_to_date())

    async def close(self) -> None:
        """End the requests that wait for an answer, with a reason."""
        if not self._end.done():
            self._end.set_result(None)
            if self._task is not None:
                self._task.cancel()
            await self.ros.run(self._destroy)

    def _create(self) -> None:
        node = self.ros.node
        for service, kind in SERVICES.items():
            self._clients[service] = node.create_client(kind, f"{self.name}/{service}")
        labels = Mailbox(self.ros, self._take_labels)
        topic = f"{self.name}/label_info"
        self._labels = node.create_subscription(LabelInfo, topic, labels.put, _LATCHED)

    def _destroy(self) -> None:
        self.ros.node.destroy_subscription(self._labels)
        for client in self._clients.values():
            self.ros.node.destroy_client(client)

    @property
    def is_known(self) -> bool:
        """Whether the node has answered and is a detector: it has settings and publishes its status."""
        return bool(self.state and self._parameters and self.status)

    @property
    def is_silent(self) -> bool:
        """Whether its diagnostics have stopped."""
        return self._heard_s is not None and time.monotonic() - self._heard_s > _SILENCE_S

    @property
    def status(self) -> StatusView | None:
        """The last diagnostics of the node as a whole."""
        return self.statuses.get(NODE_STATUS)

    @property
    def cameras(self) -> dict[str, StatusView | None]:
        """The last diagnostics of each camera by name; the only camera of a detector without names is ""."""
        names = usable_names(self._parameters.get("cameras", {}).get("value"))
        return {name: self.statuses.get(name or NODE_STATUS) for name in names or [""]}

    def as_json(self) -> dict[str, object]:
        """Everything that the page shows of the detector."""
        return {
            "name": self.name,
            "state": self.state,
            "transitions": self._transitions,
            "parameters": list(self._parameters.values()),
            "cameras": [camera_as_json(*camera) for camera in self.cameras.items()],
            "diagnostics": [asdict(status) for status in self.statuses.values()],
            "class_names": self._class_names,
            "log": self.log.as_json(),
        }

    async def set(self, values: Mapping[str, object]) -> str:
        """Set parameters, all or none; returns the reason for a refusal, "" on success."""
        try:
            request = SetParametersAtomically.Request(
                parameters=[parameter_message(name, value) for name, value in values.items()]
            )
            result = (await self._call("set_parameters_atomically", request, _ACT_S)).result
        except (ValueError, ConnectionError) as error:
            return str(error)
        finally:
            self.ask_soon()
        return "" if result.successful else in_one_line(result.reason, _MAX_WORDS) or _NO_REASON

    async def change_state(self, label: str) -> str:
        """Request a transition; returns the reason for a refusal, "" on success."""
        count = self.log.count
        what = in_one_line(label, 100)
        try:
            await self._ask_state()
            if label not in self._transitions:
                possible = ", ".join(self._transitions) or "none"
                return f"{what} is not possible while {self.state}; possible now: {possible}"
            request = ChangeState.Request(transition=Transition(label=label))
            if (await self._call("change_state", request, _ACT_S)).success:
                await self._ask_state()
                return ""
            return await self._reason(count) or f"the node refused to {label}; its log says why"
        except ConnectionError as error:
            # The process ends soon after this transition, possibly before it has sent the response.
            return "" if label == "shutdown" else str(error)
        finally:
            self.on_change(self)
            self.ask_soon()

    async def collect(self) -> tuple[str, str]:
        """Have the next image of each camera kept; returns the reason for a refusal, or "" and the answer."""
        try:
            answer = await self._call("collect", Trigger.Request())
        except ConnectionError as error:
            return str(error), ""
        words = in_one_line(answer.message, _MAX_WORDS) or _NO_REASON
        return ("", words) if answer.success else (words, "")

    async def _call(self, service: str, request: Any, timeout_s: float = _ASK_S) -> Any:
        """The response of the node; raises ConnectionError."""
        if self._end.done():
            raise ConnectionError(f"{self.name} is lost")
        return await self.ros.call(self._clients[service], request, timeout_s=timeout_s, end=self._end)

    def _take_labels(self, message: LabelInfo) -> None:
        self._class_names = class_names_of(message)
        self.on_change(self)

    def take_diagnostics(self, statuses: list[StatusView]) -> None:
        self._heard_s = time.monotonic()
        self.statuses = {status.name: status for status in statuses}
        if self.status is not None and self.status.values.get("state", self.state) != self.state:
            self.ask_soon()
        self.on_change(self)

    def ask_soon(self) -> None:
        """Query state and parameters: they may have changed."""
        self._wanted.set()

    async def _keep_up_to_date(self) -> None:
        while True:
            self._wanted.clear()
            try:
                await self._ask_state()
                await self._ask_parameters()
            except ConnectionError:
                await asyncio.sleep(_RETRY_S)
                continue
            self.on_change(self)
            await asyncio.sleep(_PACE_S)
            with suppress(asyncio.TimeoutError):
                await asyncio.wait_for(self._wanted.wait(), _REFRESH_S)

    async def _ask_state(self) -> None:
        state = await self._call("get_state", GetState.Request())
        answer = await self._call("get_available_transitions", GetAvailableTransitions.Request())
        possible = answer.available_transitions[:_MAX_TRANSITIONS]
        self.state = in_one_line(state.current_state.label, _MAX_LABEL)
        self._transitions = [in_one_line(found.transition.label, _MAX_LABEL) for found in possible]

    async def _ask_parameters(self) -> None:
        listed = await self._call("list_parameters", ListParameters.Request())
        names = [name for name in listed.result.names[:MAX_ITEMS] if SCHEMA.find(name)]
        values = (await self._call("get_parameters", GetParameters.Request(names=names))).values
        if len(values) != len(names):
            raise ConnectionError(f"{self.name} has changed its parameters meanwhile")
        self._parameters = parameters_as_json(dict(zip(names, values, strict=True)))

    async def _reason(self, count: int) -> str:
        """The problems that the node has logged since line number `count`; waits a little for them."""
        end_s = time.monotonic() + _REASON_S
        while time.monotonic() < end_s:
            if texts := self.log.problems_since(count):
                return "\n".join(texts[-3:])
            await asyncio.sleep(0.05)
        return self.status.values.get("last problem", "") if self.status is not None else ""
