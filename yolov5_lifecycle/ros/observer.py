"""Node that observes and drives other nodes."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from typing import Any

import rclpy
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rcl_interfaces.srv import GetParameters, SetParametersAtomically
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter, parameter_value_to_python

PATIENCE_S = 60.0
"""Timeout for one response; activate loads a model, possibly on a slow machine."""
_FIRST_ANSWER_S = 1.0


class Observer(Node):
    """Node that spins in the caller's thread, only during `wait_for`, `work_for` and `call`.

    Owns its rclpy context in the ROS domain `domain`. `check()` is called while waiting and may raise.
    """

    def __init__(self, name: str, *, domain: int, check: Callable[[], None] = lambda: None) -> None:
        context = Context()
        rclpy.init(args=[], context=context, domain_id=domain)
        super().__init__(name, context=context, use_global_arguments=False)
        self._check = check
        self._loop = SingleThreadedExecutor(context=context)
        self._loop.add_node(self)

    def close(self) -> None:
        """Destroy the node and its context."""
        self._loop.shutdown()
        self.destroy_node()
        rclpy.try_shutdown(context=self.context)

    def wait_for(self, condition: Callable[[], bool], what: str, *, timeout_s: float = PATIENCE_S) -> None:
        """Spin until `condition()`; raises TimeoutError naming `what` on timeout."""
        deadline_s = time.monotonic() + timeout_s
        while not condition():
            if time.monotonic() > deadline_s:
                raise TimeoutError(f"timed out after {timeout_s:g} s waiting for {what}")
            self._check()
            self._loop.spin_once(timeout_sec=0.05)

    def work_for(self, duration_s: float) -> None:
        """Spin for `duration_s` seconds."""
        end_s = time.monotonic() + duration_s
        self.wait_for(lambda: time.monotonic() >= end_s, "time to pass", timeout_s=2 * duration_s + 1)

    def call(self, client: Any, request: Any, *, timeout_s: float = PATIENCE_S) -> Any:
        """Call the service and return its response; raises TimeoutError on timeout."""
        self.wait_for(client.service_is_ready, f"the service {client.srv_name}", timeout_s=timeout_s)
        future = client.call_async(request)
        try:
            self.wait_for(future.done, f"an answer of {client.srv_name}", timeout_s=timeout_s)
        finally:
            client.remove_pending_request(future)
        return future.result()


class RemoteLifecycleNode:
    """Client for the services of the managed node `name`, fully qualified such as `/yolov5`."""

    def __init__(self, observer: Observer, name: str) -> None:
        self._observer = observer
        self._name = name
        self._change_state = observer.create_client(ChangeState, f"{name}/change_state")
        self._get_parameters = observer.create_client(GetParameters, f"{name}/get_parameters")
        self._set_parameters = observer.create_client(
            SetParametersAtomically, f"{name}/set_parameters_atomically"
        )
        # Last: a node that answers this client has discovered the others.
        self._get_state = observer.create_client(GetState, f"{name}/get_state")

    def wait_until_reachable(self) -> None:
        """Wait for the first response; raises TimeoutError on timeout.

        A service looks ready before it has discovered the client; responses sent until then are lost.
        """
        deadline_s = time.monotonic() + PATIENCE_S
        while time.monotonic() < deadline_s:
            with contextlib.suppress(TimeoutError):
                self._observer.call(self._get_state, GetState.Request(), timeout_s=_FIRST_ANSWER_S)
                return
        raise TimeoutError(f"timed out after {PATIENCE_S:g} s waiting for the node {self._name}")

    def state(self) -> str:
        """Get the lifecycle state, such as `inactive`."""
        return str(self._observer.call(self._get_state, GetState.Request()).current_state.label)

    def change_state(self, label: str) -> bool:
        """Request the transition `label`; return whether it succeeded."""
        request = ChangeState.Request(transition=Transition(label=label))
        return bool(self._observer.call(self._change_state, request).success)

    def set_parameters(self, **values: object) -> str:
        """Set the parameters atomically; return the reason for a refusal, "" on success."""
        parameters = [Parameter(name, value=value).to_parameter_msg() for name, value in values.items()]
        request = SetParametersAtomically.Request(parameters=parameters)
        result = self._observer.call(self._set_parameters, request).result
        return "" if result.successful else (result.reason or "no reason given")

    def parameter(self, name: str) -> Any:
        """Get the value of the parameter `name`, None if not set."""
        (value,) = self._observer.call(self._get_parameters, GetParameters.Request(names=[name])).values
        return parameter_value_to_python(value)
