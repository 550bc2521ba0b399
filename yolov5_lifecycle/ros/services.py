"""Services that respond to every request: oversized ones are refused, exceptions are caught."""

from __future__ import annotations

import inspect
import traceback
from collections.abc import Callable
from typing import Any

from rcl_interfaces.msg import SetParametersResult
from rclpy.exceptions import ParameterException
from rclpy.node import Node
from rclpy.service import Service

from yolov5_lifecycle.printable import in_one_line

MAX_ITEMS = 800
"""Max parameters, names or prefixes in one request; the node with overrides for 16 cameras has 648."""

MAX_REASON = 5_000
"""Max characters of the reason for a refusal."""
Handler = Callable[[Any, Any], Any]
"""(request, response) -> response, or an awaitable of one."""


def wrap_services(node: Node, handlers: dict[str, Handler]) -> None:
    """Make every service of `node` respond even if its callback raises, or a request has many items.

    `handlers` replace callbacks by service name.

    A plain rclpy node dies on the first exception in a service callback, such as for an impossible transition
    (ros2/rclpy#1209) or a parameter value of an unknown type (ros2/rclcpp#3257).
    """
    for service in node.services:
        name = service.srv_name.rpartition("/")[2]
        service.callback = _answering(node, service, handlers.get(name, service.callback))


def _answering(node: Node, service: Service, handler: Handler) -> Handler:
    def refused(request: Any, reason: str) -> Any:
        node.get_logger().warning(f"{service.srv_name}: request refused: {reason}", throttle_duration_sec=1.0)
        return _refusal(service, request, reason)

    async def answer(request: Any, response: Any) -> Any:
        if (count := _item_count(request)) > MAX_ITEMS:
            return refused(request, f"{count} items in one request; at most {MAX_ITEMS} are accepted.")
        try:
            answered = handler(request, response)
            return _printable(await answered if inspect.isawaitable(answered) else answered)
        except (ValueError, ParameterException) as error:
            return refused(request, _described(error))
        except Exception as error:  # noqa: BLE001 - logged, and the caller gets a response
            node.get_logger().error(
                f"unexpected {type(error).__name__} in {service.srv_name}:\n{traceback.format_exc()}",
                throttle_duration_sec=1.0,
            )
            return _refusal(service, request, _described(error))

    return answer


def _item_count(request: Any) -> int:
    return max(len(getattr(request, items, ())) for items in ("parameters", "names", "prefixes"))


def _printable(response: Any) -> Any:
    """Make the reasons in `response`, which quote the request, printable and bounded."""
    results = [*getattr(response, "results", []), getattr(response, "result", None)]
    for result in results:
        if isinstance(result, SetParametersResult) and result.reason:
            result.reason = in_one_line(result.reason, MAX_REASON)
    return response


def _described(error: Exception) -> str:
    return in_one_line(f"{type(error).__name__}: {str(error)[:300]}")


def _refusal(service: Service, request: Any, reason: str) -> Any:
    """New response that refuses `request`; a partially filled one may fail to serialise."""
    response = service.srv_type.Response()
    result = SetParametersResult(successful=False, reason=reason)
    if hasattr(response, "results"):
        response.results = [result] * _item_count(request)
    elif hasattr(response, "result") and isinstance(response.result, SetParametersResult):
        response.result = result
    return response
