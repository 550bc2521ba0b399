"""Size limit for service requests, checked before rclpy converts each item to Python."""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from typing import Any

from rcl_interfaces.srv import (
    DescribeParameters,
    GetParameters,
    GetParameterTypes,
    ListParameters,
    SetParameters,
    SetParametersAtomically,
)

MAX_ITEMS = 250
"""Max parameters, names or prefixes in one request; the node has fewer than 100 parameters."""

_BOUNDED = (
    DescribeParameters,
    GetParameters,
    GetParameterTypes,
    ListParameters,
    SetParameters,
    SetParametersAtomically,
)
"""Services whose request starts with the sequence of its items."""


@dataclass(frozen=True)
class OversizedRequest:
    """Placeholder for a request that has more than MAX_ITEMS items or cannot be converted."""

    count: int
    reason: str


class _Sequence(ctypes.Structure):
    """Memory layout of a sequence in rosidl_runtime_c."""

    _fields_ = (("data", ctypes.c_void_p), ("size", ctypes.c_size_t), ("capacity", ctypes.c_size_t))


_Convert = ctypes.PYFUNCTYPE(ctypes.py_object, ctypes.c_void_p)
"""C function that converts the C message at an address to a Python message."""


class BoundedService:
    """Replaces `service_type` in an rclpy service, whose callback may then get an `OversizedRequest`.

    rclpy converts a request in one uninterruptible call, 35 us per parameter: half a second for the 16,000
    that fit in 1 MB. The conversion function belongs to the message type, so this type replaces it with one
    that checks the number of items first.
    """

    def __init__(self, service_type: Any) -> None:
        self.Response = service_type.Response
        metaclass = type(service_type.Request)
        self._convert = _Convert(_pointer(metaclass._CONVERT_TO_PY))
        self._bounded = _Convert(self._to_python)  # kept alive as long as the capsule
        names = ("_CREATE_ROS_MESSAGE", "_DESTROY_ROS_MESSAGE", "_CONVERT_FROM_PY", "_TYPE_SUPPORT")
        attributes = {name: getattr(metaclass, name) for name in names}
        attributes["_CONVERT_TO_PY"] = _capsule(self._bounded)
        self.Request = type("BoundedMetaclass", (type,), attributes)("Request", (), {})

    def _to_python(self, address: int) -> object:
        count = int(_Sequence.from_address(address).size)
        if count > MAX_ITEMS:
            return OversizedRequest(count, f"{count} items in one request; at most {MAX_ITEMS} are accepted.")
        try:
            return self._convert(address)
        except Exception as error:  # noqa: BLE001 - called from C, where an exception would be lost
            return OversizedRequest(count, f"the request cannot be read ({type(error).__name__}).")


def bounded(service_type: Any) -> Any:
    """Return `service_type`, wrapped in `BoundedService` if its request has an unbounded sequence."""
    return BoundedService(service_type) if service_type in _BOUNDED else service_type


def _pointer(capsule: object) -> int:
    function = ctypes.pythonapi.PyCapsule_GetPointer
    function.argtypes, function.restype = (ctypes.py_object, ctypes.c_char_p), ctypes.c_void_p
    return int(function(capsule, None))


def _capsule(function: Any) -> object:
    make = ctypes.pythonapi.PyCapsule_New
    make.argtypes, make.restype = (ctypes.c_void_p, ctypes.c_char_p, ctypes.c_void_p), ctypes.py_object
    return make(ctypes.cast(function, ctypes.c_void_p), None, None)
