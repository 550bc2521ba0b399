"""Services that answer whatever they are asked."""

from __future__ import annotations

import inspect
import traceback
from collections.abc import Callable
from typing import Any

from rcl_interfaces.msg import SetParametersResult
from rclpy.exceptions import ParameterException
from rclpy.node import Node
from rclpy.service import Service

from yolov5_lifecycle.one_line import in_one_line

Handler = Callable[[Any, Any], Any]
"""(request, response) -> response, or an awaitable of one."""


def harden(node: Node, handlers: dict[str, Handler]) -> None:
    """Make every service of `node` answer even when its callback raises; `handlers` replace callbacks by
    name.

    A plain rclpy node dies of the first exception in a service callback: of a transition that is not possible
    now (ros2/rclpy#1209) or of a parameter value of a type that does not exist (ros2/rclcpp#3257).
    """
    for service in node.services:
        name = service.srv_name.rpartition("/")[2]
        service.callback = _answering(node, service, handlers.get(name, service.callback))


def _answering(node: Node, service: Service, handler: Handler) -> Handler:
    async def answer(request: Any, response: Any) -> Any:
        try:
            answered = handler(request, response)
            return await answered if inspect.isawaitable(answered) else answered
        except (ValueError, ParameterException) as error:
            problem = _described(error)
            node.get_logger().warning(
                f"{service.srv_name}: request refused: {problem}", throttle_duration_sec=1.0
            )
        except Exception as error:  # noqa: BLE001 - logged, and the caller gets an answer
            problem = _described(error)
            node.get_logger().error(
                f"unexpected {type(error).__name__} in {service.srv_name}:\n{traceback.format_exc()}",
                throttle_duration_sec=1.0,
            )
        return _refusal(service, request, problem)

    return answer


def _described(error: Exception) -> str:
    return in_one_line(f"{type(error).__name__}: {str(error)[:300]}")


def _refusal(service: Service, request: Any, reason: str) -> Any:
    """A fresh response that says no; a half-filled one may not even serialise."""
    response = service.srv_type.Response()
    result = SetParametersResult(successful=False, reason=reason)
    if hasattr(response, "results"):
        response.results = [result] * len(request.parameters)
    elif hasattr(response, "result") and isinstance(response.result, SetParametersResult):
        response.result = result
    return response
