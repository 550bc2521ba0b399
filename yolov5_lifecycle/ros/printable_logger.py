"""Nodes whose log messages have no unprintable characters."""

from __future__ import annotations

from typing import Any

from rclpy.impl.logging_severity import LoggingSeverity
from rclpy.impl.rcutils_logger import RcutilsLogger
from rclpy.node import Node

from yolov5_lifecycle.printable import in_lines
from yolov5_lifecycle.ros.rclpy_internals import attribute_logs_to_callers_of

attribute_logs_to_callers_of(__file__)


class PrintableLogger(RcutilsLogger):
    """rclpy logger whose messages are bounded and made printable by `in_lines`."""

    def log(self, message: object, severity: LoggingSeverity, **kwargs: Any) -> bool:
        return bool(super().log(in_lines(str(message)), severity, **kwargs))


class PrintableNode(Node):
    """Node with a `PrintableLogger`, which also handles rclpy's own messages."""

    def __init__(self, name: str, **options: Any) -> None:
        self._printable_logger: PrintableLogger | None = None  # rclpy logs while it constructs the node
        super().__init__(name, **options)

    def get_logger(self) -> RcutilsLogger:
        if self._printable_logger is None:
            self._printable_logger = PrintableLogger(super().get_logger().name)
        return self._printable_logger
