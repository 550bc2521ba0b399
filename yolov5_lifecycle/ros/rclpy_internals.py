"""All uses of undocumented rclpy code, each with the source file or issue that it depends on.

Written against rclpy 7.1 (Jazzy) and 9.1 (Kilted). `test/test_architecture.py` forbids private attributes of
other packages everywhere else.
"""

from __future__ import annotations

import ctypes
import functools
import os
import weakref
from collections.abc import Callable, Sequence
from typing import Any

from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.impl import rcutils_logger
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.lifecycle import LifecycleNode
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.service import Service
from rclpy.subscription import Subscription
from rclpy.topic_endpoint_info import TopicEndpointInfo

Convert = Callable[[int], object]
"""Converts the C message at an address to a Python message."""


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


def take_message(subscription: Subscription, message_type: type) -> Any | None:
    """Take the next message of a subscription that no executor serves; None if there is none.

    rclpy/executors.py, `Executor._take_subscription`: rclpy has no public method for it; rclcpp has `take`.
    """
    taken = subscription.handle.take_message(message_type, False)
    return None if taken is None else taken[0]


def replace_callback(service: Service, callback: Callable[[Any, Any], Any]) -> None:
    """Handle requests with `callback`, which may return an awaitable.

    rclpy/executors.py, `Executor._take_service`, reads the attribute for each request; rclpy offers no way to
    handle exceptions in callbacks of the services that it creates itself (ros2/rclpy#1209).
    """
    service.callback = callback


def replace_conversion(service: Service, convert: Callable[[Convert, int], object]) -> None:
    """Convert requests with `convert`; see `_ConvertedService`."""
    service.srv_type = _ConvertedService(service.srv_type, convert)


class SequenceLayout(ctypes.Structure):
    """Memory layout of a sequence in rosidl_runtime_c (primitives_sequence.h and generated structures)."""

    _fields_ = (("data", ctypes.c_void_p), ("size", ctypes.c_size_t), ("capacity", ctypes.c_size_t))


class _ConvertedService:
    """Replaces the type of an rclpy service: `convert(original, address)` converts its requests.

    `original(address)` is the conversion that comes with the message type. `convert` must not raise: it is
    called from C.

    rclpy/executors.py, `Executor._take_service`, passes `srv_type.Request` to `Service.service_take_request`,
    which reads the capsules below from its metaclass (rclpy/src/rclpy/utils.cpp, `common_get_type_support`,
    `create_from_py`, `convert_to_py`). They are generated by rosidl_generator_py (`_srv.py.em`).
    """

    def __init__(self, service_type: Any, convert: Callable[[Convert, int], object]) -> None:
        metaclass = type(service_type.Request)
        original = _FUNCTION(_pointer(metaclass._CONVERT_TO_PY))
        self.Response = service_type.Response
        # Kept alive as long as the capsule that points to it.
        self._function = _FUNCTION(functools.partial(convert, original))
        names = ("_CREATE_ROS_MESSAGE", "_DESTROY_ROS_MESSAGE", "_CONVERT_FROM_PY", "_TYPE_SUPPORT")
        attributes = {name: getattr(metaclass, name) for name in names}
        attributes["_CONVERT_TO_PY"] = _capsule(self._function)
        self.Request = type("ConvertedMetaclass", (type,), attributes)("Request", (), {})


_FUNCTION = ctypes.PYFUNCTYPE(ctypes.py_object, ctypes.c_void_p)


def _pointer(capsule: object) -> int:
    function = ctypes.pythonapi.PyCapsule_GetPointer
    function.argtypes, function.restype = (ctypes.py_object, ctypes.c_char_p), ctypes.c_void_p
    return int(function(capsule, None))


def _capsule(function: Any) -> object:
    make = ctypes.pythonapi.PyCapsule_New
    make.argtypes, make.restype = (ctypes.c_void_p, ctypes.c_char_p, ctypes.c_void_p), ctypes.py_object
    return make(ctypes.cast(function, ctypes.c_void_p), None, None)
