"""Logger that replaces unprintable characters in messages."""

from __future__ import annotations

from typing import Any

from rclpy.impl.logging_severity import LoggingSeverity
from rclpy.impl.rcutils_logger import RcutilsLogger

from yolov5_lifecycle.printable import in_lines
from yolov5_lifecycle.ros.rclpy_internals import attribute_logs_to_callers_of

attribute_logs_to_callers_of(__file__)


class PrintableLogger(RcutilsLogger):
    """rclpy logger whose messages are bounded and made printable by `in_lines`."""

    def log(self, message: object, severity: LoggingSeverity, **kwargs: Any) -> bool:
        return bool(super().log(in_lines(str(message)), severity, **kwargs))
