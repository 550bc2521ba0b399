"""Logger that replaces unprintable characters in messages."""

from __future__ import annotations

import os
from typing import Any

from rclpy.impl import rcutils_logger
from rclpy.impl.logging_severity import LoggingSeverity
from rclpy.impl.rcutils_logger import RcutilsLogger

from yolov5_lifecycle.printable import in_lines

# rclpy identifies a throttled message by the line of its caller; files in this list, such as this one, are
# skipped when it looks for the caller.
rcutils_logger._internal_callers.append(os.path.realpath(__file__))


class PrintableLogger(RcutilsLogger):
    """rclpy logger whose messages are bounded and made printable by `in_lines`."""

    def log(self, message: object, severity: LoggingSeverity, **kwargs: Any) -> bool:
        return bool(super().log(in_lines(str(message)), severity, **kwargs))
