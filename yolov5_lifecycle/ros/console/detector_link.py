"""The clients and subscriptions of the console for one detector."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
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
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from vision_msgs.msg import LabelInfo

from yolov5_lifecycle.ros.console.ros_thread import NotReachedError, RosThread

ASK_S = 3.0
"""Timeout of a query, which is then repeated."""
ACT_S = 300.0
"""Timeout of a transition or change, which may load a model on a slow machine."""
_LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
_SERVICES = {
    "get_state": GetState,
    "get_available_transitions": GetAvailableTransitions,
    "change_state": ChangeState,
    "list_parameters": ListParameters,
    "describe_parameters": DescribeParameters,
    "get_parameters": GetParameters,
    "set_parameters_atomically": SetParametersAtomically,
}


class DetectorLink:
    """Talks to the detector called `name`; its coroutines raise NotReachedError, also when it is closed."""

    def __init__(self, ros: RosThread, name: str) -> None:
        self.name = name
        self._ros = ros
        self._clients: dict[str, Any] = {}
        self._subscriptions: list[Any] = []
        self._end: asyncio.Future[None] = asyncio.get_running_loop().create_future()

    async def open(
        self, *, on_transition: Callable[[], object], on_class_names: Callable[[list[str]], object]
    ) -> None:
        """Create clients and subscriptions.

        `on_transition()` is called after each change of the node's state, `on_class_names(names)` with the
        class names of its model, both in the thread of the event loop.
        """

        def take_event(_: TransitionEvent) -> None:
            self._ros.post(on_transition)

        def take_labels(message: LabelInfo) -> None:
            self._ros.post(on_class_names, [str(one.class_name) for one in message.class_map])

        await self._ros.run(self._create, self._ros.node, take_event, take_labels)

    async def close(self) -> None:
        """End the calls that wait for an answer, then destroy clients and subscriptions."""
        if not self._end.done():
            self._end.set_result(None)
        await self._ros.run(self._destroy, self._ros.node)

    async def state(self) -> tuple[str, list[str]]:
        """The state, and the labels of the transitions that are possible in it."""
        state = await self._ask("get_state", GetState.Request())
        transitions = await self._ask("get_available_transitions", GetAvailableTransitions.Request())
        labels = [str(found.transition.label) for found in transitions.available_transitions]
        return str(state.current_state.label), labels

    async def parameters(self) -> list[tuple[ParameterDescriptor, ParameterValue]]:
        """All parameters with their values."""
        listed = await self._ask("list_parameters", ListParameters.Request())
        names = list(listed.result.names)
        described = await self._ask("describe_parameters", DescribeParameters.Request(names=names))
        values = await self._ask("get_parameters", GetParameters.Request(names=names))
        return list(zip(described.descriptors, values.values, strict=False))

    async def change_state(self, label: str) -> bool:
        """Whether the transition succeeded."""
        request = ChangeState.Request(transition=Transition(label=label))
        return bool((await self._call("change_state", request, ACT_S)).success)

    async def set_parameters(self, messages: list[ParameterMessage]) -> str:
        """Set all parameters or none; return the reason for a refusal, "" on success."""
        request = SetParametersAtomically.Request(parameters=messages)
        result = (await self._call("set_parameters_atomically", request, ACT_S)).result
        return "" if result.successful else str(result.reason) or "the node gave no reason"

    async def _ask(self, service: str, request: Any) -> Any:
        return await self._call(service, request, ASK_S)

    async def _call(self, service: str, request: Any, timeout_s: float) -> Any:
        if self._end.done():
            raise NotReachedError(f"{self.name} is lost")
        client = self._clients[service]
        return await self._ros.call(client, request, timeout_s=timeout_s, end=self._end)

    def _create(
        self,
        node: Node,
        take_event: Callable[[TransitionEvent], None],
        take_labels: Callable[[LabelInfo], None],
    ) -> None:
        for service, service_type in _SERVICES.items():
            self._clients[service] = node.create_client(service_type, f"{self.name}/{service}")
        self._subscriptions = [
            node.create_subscription(TransitionEvent, f"{self.name}/transition_event", take_event, 10),
            node.create_subscription(LabelInfo, f"{self.name}/label_info", take_labels, _LATCHED),
        ]

    def _destroy(self, node: Node) -> None:
        for subscription in self._subscriptions:
            node.destroy_subscription(subscription)
        for client in self._clients.values():
            node.destroy_client(client)
        self._subscriptions, self._clients = [], {}
