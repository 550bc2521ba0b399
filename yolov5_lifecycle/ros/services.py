"""Services that respond to every request: oversized ones are refused, exceptions are caught."""

from __future__ import annotations

import inspect
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from rcl_interfaces.msg import SetParametersResult
from rcl_interfaces.srv import (
    DescribeParameters,
    GetParameters,
    GetParameterTypes,
    ListParameters,
    SetParameters,
    SetParametersAtomically,
)
from rclpy.exceptions import ParameterException
from rclpy.node import Node
from rclpy.service import Service

from yolov5_lifecycle.printable import in_one_line
from yolov5_lifecycle.ros.rclpy_internals import (
    Convert,
    SequenceLayout,
    replace_callback,
    replace_conversion,
)

MAX_ITEMS = 800
"""Max parameters, names or prefixes in one request; the node with overrides for 16 cameras has 648."""
MAX_RESULTS = 1000
"""Max results in the response to an oversized request; each takes 2 us to send."""

_MAX_REASON = 5_000
"""Max characters of the reason for a refusal."""
_BOUNDED = (
    DescribeParameters,
    GetParameters,
    GetParameterTypes,
    ListParameters,
    SetParameters,
    SetParametersAtomically,
)
"""Services whose request starts with the sequence of its items."""
Handler = Callable[[Any, Any], Any]
"""(request, response) -> response, or an awaitable of one."""


@dataclass(frozen=True)
class OversizedRequest:
    """Placeholder for a request that has more than MAX_ITEMS items or cannot be converted."""

    count: int
    reason: str


def harden(node: Node, handlers: dict[str, Handler]) -> None:
    """Make every service of `node` respond even if its callback raises.

    `handlers` replace callbacks by service name. Requests with more than MAX_ITEMS items are refused before
    rclpy converts them, in one uninterruptible call of 35 us per parameter: half a second for the 16,000 that
    fit in 1 MB.

    A plain rclpy node dies on the first exception in a service callback, such as for an impossible transition
    (ros2/rclpy#1209) or a parameter value of an unknown type (ros2/rclcpp#3257).
    """
    for service in node.services:
        name = service.srv_name.rpartition("/")[2]
        replace_callback(service, _answering(node, service, handlers.get(name, service.callback)))
        if service.srv_type in _BOUNDED:
            replace_conversion(service, _bounded)


def _bounded(convert: Convert, address: int) -> object:
    count = int(SequenceLayout.from_address(address).size)
    if count > MAX_ITEMS:
        return OversizedRequest(count, f"{count} items in one request; at most {MAX_ITEMS} are accepted.")
    try:
        return convert(address)
    except Exception as error:  # noqa: BLE001 - called from C, where an exception would be lost
        return OversizedRequest(count, f"the request cannot be read ({type(error).__name__}).")


def _answering(node: Node, service: Service, handler: Handler) -> Handler:
    async def answer(request: Any, response: Any) -> Any:
        if isinstance(request, OversizedRequest):
            node.get_logger().warning(
                f"{service.srv_name}: request refused: {request.reason}", throttle_duration_sec=1.0
            )
            return _refusal(service, request.count, request.reason)
        try:
            answered = handler(request, response)
            return _printable(await answered if inspect.isawaitable(answered) else answered)
        except (ValueError, ParameterException) as error:
            problem = _described(error)
            node.get_logger().warning(
                f"{service.srv_name}: request refused: {problem}", throttle_duration_sec=1.0
            )
        except Exception as error:  # noqa: BLE001 - logged, and the caller gets a response
            problem = _described(error)
            node.get_logger().error(
                f"unexpected {type(error).__name__} in {service.srv_name}:\n{traceback.format_exc()}",
                throttle_duration_sec=1.0,
            )
        return _refusal(service, len(getattr(request, "parameters", ())), problem)

    return answer


def _printable(response: Any) -> Any:
    """Make the reasons in `response`, which quote the request, printable and bounded."""
    results = [*getattr(response, "results", []), getattr(response, "result", None)]
    for result in results:
        if isinstance(result, SetParametersResult) and result.reason:
            result.reason = in_one_line(result.reason, _MAX_REASON)
    return response


def _described(error: Exception) -> str:
    return in_one_line(f"{type(error).__name__}: {str(error)[:300]}")


def _refusal(service: Service, count: int, reason: str) -> Any:
    """New response that refuses `count` items; a partially filled one may fail to serialise."""
    response = service.srv_type.Response()
    result = SetParametersResult(successful=False, reason=reason)
    if hasattr(response, "results"):
        response.results = [result] * min(count, MAX_RESULTS)
    elif hasattr(response, "result") and isinstance(response.result, SetParametersResult):
        response.result = result
    return response
