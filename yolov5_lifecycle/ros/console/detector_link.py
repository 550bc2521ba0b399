"""The clients and subscriptions of the console for one detector."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping
from typing import Any

from lifecycle_msgs.msg import Transition, TransitionEvent
from lifecycle_msgs.srv import ChangeState, GetAvailableTransitions, GetState
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.msg import ParameterDescriptor, ParameterValue
from rcl_interfaces.srv import (
    DescribeParameters,
    GetParameters,
    ListParameters,
    SetParametersAtomically,
)
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_srvs.srv import Trigger
from vision_msgs.msg import LabelInfo

from yolov5_lifecycle.printable import in_one_line
from yolov5_lifecycle.ros.console.ros_thread import Mailbox, NotReachedError, RosThread
from yolov5_lifecycle.ros.console.views import class_names_of
from yolov5_lifecycle.ros.services import MAX_ITEMS

ASK_S = 3.0
"""Timeout of what a node answers at once, such as a query, which is then repeated."""
ACT_S = 300.0
"""Timeout of a transition or change, which may load a model on a slow machine."""
_MAX_TRANSITIONS, _MAX_LABEL, _MAX_WORDS = 30, 100, 5_000
_LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
_SERVICES = {
    "get_state": GetState,
    "get_available_transitions": GetAvailableTransitions,
    "change_state": ChangeState,
    "list_parameters": ListParameters,
    "describe_parameters": DescribeParameters,
    "get_parameters": GetParameters,
    "set_parameters_atomically": SetParametersAtomically,
    "collect": Trigger,
}


class DetectorLink:
    """Talks to the detector called `name`; its coroutines raise NotReachedError, also when it is closed."""

    def __init__(self, ros: RosThread, name: str) -> None:
        self.name = name
        self.class_names: list[str] = []
        """Of the model, once it has told them."""
        self._ros = ros
        self._clients: dict[str, Any] = {}
        self._subscriptions: list[Any] = []
        self._end: asyncio.Future[None] = asyncio.get_running_loop().create_future()

    async def open(self, on_change: Callable[[], object]) -> None:
        """Create clients and subscriptions.

        `on_change()` is called after the node has perhaps changed its state or `class_names`.
        """

        def take_labels(message: LabelInfo) -> None:
            self.class_names = class_names_of(message)
            on_change()

        transitions = Mailbox[TransitionEvent](self._ros, lambda _: on_change())
        await self._ros.run(self._create, transitions.put, Mailbox(self._ros, take_labels).put)

    async def close(self) -> None:
        """End the calls that wait for an answer, then destroy clients and subscriptions."""
        if not self._end.done():
            self._end.set_result(None)
        await self._ros.run(self._destroy)

    async def state(self) -> tuple[str, list[str]]:
        """The state, and the labels of the transitions that are possible in it."""
        state = await self._ask("get_state", GetState.Request())
        transitions = await self._ask("get_available_transitions", GetAvailableTransitions.Request())
        possible = transitions.available_transitions[:_MAX_TRANSITIONS]
        labels = [in_one_line(found.transition.label, _MAX_LABEL) for found in possible]
        return in_one_line(state.current_state.label, _MAX_LABEL), labels

    async def parameters(
        self, known: Mapping[str, ParameterDescriptor]
    ) -> list[tuple[ParameterDescriptor, ParameterValue]]:
        """All parameters with their values; those whose descriptors are `known` are not described again."""
        listed = await self._ask("list_parameters", ListParameters.Request())
        names = list(listed.result.names)[:MAX_ITEMS]
        descriptors = dict(known)
        if new := [name for name in names if name not in known]:
            answer = await self._ask("describe_parameters", DescribeParameters.Request(names=new))
            descriptors |= {str(one.name): one for one in answer.descriptors}
        values = (await self._ask("get_parameters", GetParameters.Request(names=names))).values
        if len(values) != len(names) or not descriptors.keys() >= set(names):
            raise NotReachedError(f"{self.name} has changed its parameters meanwhile")
        return [(descriptors[name], value) for name, value in zip(names, values, strict=True)]

    async def change_state(self, label: str) -> bool:
        """Whether the transition succeeded."""
        request = ChangeState.Request(transition=Transition(label=label))
        return bool((await self._call("change_state", request, ACT_S)).success)

    async def set_parameters(self, messages: list[ParameterMessage]) -> str:
        """Set all parameters or none; return the reason for a refusal, "" on success."""
        request = SetParametersAtomically.Request(parameters=messages)
        result = (await self._call("set_parameters_atomically", request, ACT_S)).result
        reason = in_one_line(result.reason, _MAX_WORDS) or "the node gave no reason"
        return "" if result.successful else reason

    async def collect(self) -> tuple[bool, str]:
        """Ask for the next image of each camera: whether it will be kept, and the node's words."""
        answer = await self._ask("collect", Trigger.Request())
        return bool(answer.success), in_one_line(answer.message, _MAX_WORDS)

    async def _ask(self, service: str, request: Any) -> Any:
        return await self._call(service, request, ASK_S)

    async def _call(self, service: str, request: Any, timeout_s: float) -> Any:
        if self._end.done():
            raise NotReachedError(f"{self.name} is lost")
        client = self._clients[service]
        return await self._ros.call(client, request, timeout_s=timeout_s, end=self._end)

    def _create(
        self, hear_transition: Callable[[TransitionEvent], None], hear_labels: Callable[[LabelInfo], None]
    ) -> None:
        create_client, subscribe = self._ros.node.create_client, self._ros.node.create_subscription
        for service, service_type in _SERVICES.items():
            self._clients[service] = create_client(service_type, f"{self.name}/{service}")
        self._subscriptions = [
            subscribe(TransitionEvent, f"{self.name}/transition_event", hear_transition, 10),
            subscribe(LabelInfo, f"{self.name}/label_info", hear_labels, _LATCHED),
        ]

    def _destroy(self) -> None:
        for subscription in self._subscriptions:
            self._ros.node.destroy_subscription(subscription)
        for client in self._clients.values():
            self._ros.node.destroy_client(client)
        self._subscriptions, self._clients = [], {}
