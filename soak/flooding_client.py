"""A client that sends requests of maximum size one after another: `flooding_client.py FLOOD`."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

import rclpy
from rcl_interfaces.msg import Parameter, ParameterValue
from rcl_interfaces.srv import (
    DescribeParameters,
    GetParameters,
    GetParameterTypes,
    ListParameters,
    SetParameters,
    SetParametersAtomically,
)

from yolov5_lifecycle.ros.services import MAX_ITEMS

_NODE = "/yolov5"
_MEGABYTE = 1_000_000
_ANSWER_S = 20.0


_HALF = ParameterValue(type=3, double_value=0.5)
_BAD = ParameterValue(type=3, double_value=-1.0)
_TRUE = ParameterValue(type=1, bool_value=True)
_UNKNOWN_CLASSES = ParameterValue(type=9, string_array_value=["circl" * 18] * 9_999)
_ENDLESS_CLASSES = ParameterValue(type=9, string_array_value=["a"] * 120_000)
_ENDLESS_BOOLEANS = ParameterValue(type=6, bool_array_value=[True] * _MEGABYTE)
_ENDLESS_STRING = ParameterValue(type=4, string_value="a" * _MEGABYTE)
_NAMES = ["lazy"] * (_MEGABYTE // 12)
_TYPO = "confidence_treshold"


def _one_by_one(name: str, count: int, value: ParameterValue) -> SetParameters.Request:
    """A request with `count` parameters; {} in the name is replaced by their index."""
    return SetParameters.Request(parameters=_parameters(name, count, value))


def _together(name: str, count: int, value: ParameterValue) -> SetParametersAtomically.Request:
    return SetParametersAtomically.Request(parameters=_parameters(name, count, value))


def _parameters(name: str, count: int, value: ParameterValue) -> list[Parameter]:
    return [Parameter(name=name.format(number), value=value) for number in range(count)]


FLOODS: dict[str, Callable[[], Any]] = {
    "look-alikes": lambda: _one_by_one(_TYPO + "{}", 10_000, _HALF),
    "look-alikes that are read": lambda: _one_by_one(_TYPO + "{}", MAX_ITEMS, _HALF),
    "long look-alikes": lambda: _together(_TYPO * 200 + "{}", MAX_ITEMS, _HALF),
    "shortest parameters": lambda: _together("a", 16_000, _TRUE),
    "bad values": lambda: _one_by_one("max_rate", MAX_ITEMS, _BAD),
    "good values": lambda: _one_by_one("lazy", MAX_ITEMS, _TRUE),
    "unknown classes": lambda: _one_by_one("classes", 1, _UNKNOWN_CLASSES),
    "classes without end": lambda: _one_by_one("classes", 1, _ENDLESS_CLASSES),
    "booleans without end": lambda: _one_by_one("classes", 1, _ENDLESS_BOOLEANS),
    "a string without end": lambda: _one_by_one("weights", 1, _ENDLESS_STRING),
    "names to get": lambda: GetParameters.Request(names=_NAMES),
    "names to describe": lambda: DescribeParameters.Request(names=_NAMES),
    "names of types": lambda: GetParameterTypes.Request(names=_NAMES),
    "prefixes": lambda: ListParameters.Request(prefixes=_NAMES),
}
"""Requests by content; each has at most a megabyte."""
_SERVICES = {
    service.Request: (service, name)
    for service, name in (
        (SetParameters, "set_parameters"),
        (SetParametersAtomically, "set_parameters_atomically"),
        (GetParameters, "get_parameters"),
        (GetParameterTypes, "get_parameter_types"),
        (DescribeParameters, "describe_parameters"),
        (ListParameters, "list_parameters"),
    )
}


def main(flood: str) -> None:
    """Resend the same request after every response and print the number of responses, until killed."""
    request = FLOODS[flood]()
    service, name = _SERVICES[type(request)]
    rclpy.init(args=[])
    node = rclpy.create_node("flood")
    client = node.create_client(service, f"{_NODE}/{name}")
    assert client.wait_for_service(_ANSWER_S)
    answers = 0
    while True:
        future = client.call_async(request)
        rclpy.spin_until_future_complete(node, future, timeout_sec=_ANSWER_S)
        assert future.done(), "no answer"
        answers += 1
        print(f"answered {answers}", flush=True)


if __name__ == "__main__":
    main(sys.argv[1])
