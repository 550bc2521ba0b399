"""All uses of undocumented rclpy code, each with the source file or issue that it depends on.

Written against rclpy 7.1 (Jazzy) and 9.1 (Kilted). `test/test_architecture.py` forbids private attributes of
other packages everywhere else.
"""

from __future__ import annotations

import os
import weakref
from collections.abc import Callable, Sequence
from typing import Any

from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import SingleThreadedExecutor
from rclpy.impl import rcutils_logger
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.lifecycle import LifecycleNode
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.topic_endpoint_info import TopicEndpointInfo


def parameter_overrides(node: Node) -> dict[str, Parameter]:
    """Overrides from parameter files and the command line by name, declared or not.

    rclpy/node.py, `Node.__init__`: overrides of undeclared parameters have no public accessor, and rclpy
    ignores them silently.
    """
    return dict(node._parameter_overrides)


def lifecycle_state(node: LifecycleNode) -> str:
    """Name of the current lifecycle state, such as `inactive`.

    rclpy/lifecycle/node.py: in-process, the state is exposed only through the callback of the service
    `get_state`.
    """
    return str(node._state_machine.current_state[1])


def available_transitions(node: LifecycleNode) -> Sequence[tuple[Any, ...]]:
    """Rows (id, label, ...) of the transitions that are possible now.

    rclpy/lifecycle/node.py: `trigger_*` raises RCLError for an impossible transition, which ends the process
    when it comes from a service (ros2/rclpy#1209).
    """
    return tuple(node._state_machine.available_transitions)


def destroy_state_machine(node: LifecycleNode) -> None:
    """Destroy the lifecycle services, which `destroy_node` leaves behind, still accepting requests.

    rclpy/lifecycle/node.py, `LifecycleNodeMixin.__init__`: they are added to the node's services, but their
    handles belong to the state machine.
    """
    node._state_machine.destroy_when_not_in_use()


def publishers_on(node: Node, name: str) -> list[TopicEndpointInfo]:
    """The publishers on the topic with the full name `name`, whatever `node` remaps it to.

    rclpy/node.py, `Node._get_info_by_topic`: remaps the name, although its documentation denies that.
    """
    with node.handle:
        rows = rclpy_implementation.rclpy_get_publishers_info_by_topic(node.handle, name, False)
    return [TopicEndpointInfo(**row) for row in rows]


def attribute_logs_to_callers_of(path: str) -> None:
    """Skip the file at `path` when rclpy looks for the line that logs a message.

    rclpy/impl/rcutils_logger.py, `_find_caller`: a throttled message is identified by that line. The list is
    kept "to preserve any filenames that may have been added by third parties".
    """
    rcutils_logger._internal_callers.append(os.path.realpath(path))


class ForgettingGroup(ReentrantCallbackGroup):
    """Callback group that drops publishers, subscriptions and other entities once they are destroyed.

    rclpy's groups keep a dead reference to each forever (ros2/rclpy#1356): 2 KB a camera and configure.
    """

    def add_entity(self, entity: object) -> None:
        self.entities.add(weakref.ref(entity, self.entities.discard))


class ResilientExecutor(SingleThreadedExecutor):
    """Drops and counts a request or message that cannot be taken, and goes on serving its endpoint.

    rclpy/executors.py, `Executor._make_handler`: after an exception there, the endpoint stays marked as in
    progress and is never served again.
    """

    dropped = 0

    def _make_handler(self, entity: Any, node: Node, take_from_wait_list: Callable[[Any], Any]) -> Any:
        def take(entity: Any) -> Any:
            try:
                return take_from_wait_list(entity)
            except Exception as error:  # noqa: BLE001 - logged; rclpy skips what is None
                self.dropped += 1
                node.get_logger().error(
                    f"dropped a request or message that cannot be taken, {self.dropped} by now "
                    f"({type(error).__name__}: {error})",
                    throttle_duration_sec=1.0,
                )
                return None

        return super()._make_handler(entity, node, take)
