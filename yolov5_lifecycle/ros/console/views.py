"""What a detector tells about itself in messages, as the page shows it: printable and bounded."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import asdict, dataclass

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rcl_interfaces.msg import Log
from vision_msgs.msg import LabelInfo

from yolov5_lifecycle.printable import in_lines, in_one_line
from yolov5_lifecycle.settings.camera_overrides import MAX_CAMERAS

KEPT_LINES = 100
STALE = 3
_MAX_NAME, _MAX_TEXT, _MAX_VALUES = 200, 5_000, 100
_MAX_LINE = 4_000
"""Characters of a message of the log; a detector with one camera lists its settings in 2,500."""
_MAX_CLASSES = 10_000
_NOTHING_TO_TELL = "detecting"
_LEVELS = ((50, "fatal"), (40, "error"), (30, "warn"), (20, "info"))
_PROBLEMS = ("warn", "error", "fatal")


@dataclass(frozen=True)
class StatusView:
    """One status of /diagnostics. `name`: of the camera, or NODE_STATUS; `level`: 0 (OK) to 3 (stale)."""

    name: str
    level: int
    message: str
    values: dict[str, str]

    def number(self, key: str) -> float | None:
        """The value of `key` as a finite number; None if it has none."""
        try:
            number = float(self.values[key])
        except (KeyError, ValueError):
            return None
        return number if math.isfinite(number) else None


def statuses_of(message: DiagnosticArray) -> list[StatusView]:
    """The statuses of the node that sent the first one, at most as many as a detector has."""
    statuses = message.status[: MAX_CAMERAS + 1]
    return [_status(one) for one in statuses if one.hardware_id == statuses[0].hardware_id]


def _status(status: DiagnosticStatus) -> StatusView:
    values = {
        in_one_line(pair.key, _MAX_NAME): in_lines(pair.value, _MAX_TEXT)
        for pair in status.values[:_MAX_VALUES]
    }
    name = in_one_line(status.name.rpartition(": ")[2], _MAX_NAME)
    level = min(int.from_bytes(status.level, "little"), STALE)
    return StatusView(name, level, in_lines(status.message, _MAX_TEXT), values)


def camera_as_json(name: str, status: StatusView | None) -> dict[str, object]:
    """What the page shows of a camera."""
    return {
        "name": name,
        "rate_hz": status and status.number("rate Hz"),
        "latency_ms": status and status.number("latency median ms"),
        "latency_p95_ms": status and status.number("latency p95 ms"),
        "message": "" if status is None or status.message == _NOTHING_TO_TELL else status.message,
        "level": status.level if status else 0,
    }


def class_names_of(message: LabelInfo) -> list[str]:
    return [in_one_line(each.class_name, _MAX_NAME) for each in message.class_map[:_MAX_CLASSES]]


@dataclass(frozen=True)
class LogLine:
    """One message; `level` is debug, info, warn, error or fatal."""

    stamp_s: float
    level: str
    text: str


def line_of(message: Log) -> LogLine:
    level = next((name for least, name in _LEVELS if message.level >= least), "debug")
    stamp_s = message.stamp.sec + message.stamp.nanosec * 1e-9
    return LogLine(stamp_s, level, in_lines(message.msg, _MAX_LINE))


class LogView:
    """The last KEPT_LINES lines of a logger."""

    def __init__(self) -> None:
        self._lines: deque[LogLine] = deque(maxlen=KEPT_LINES)
        self.count = 0
        """Number of lines so far, including those no longer kept."""

    def add(self, line: LogLine) -> None:
        self._lines.append(line)
        self.count += 1

    def problems_since(self, count: int) -> list[str]:
        """The problems among the lines after the first `count`."""
        fresh = min(self.count - count, len(self._lines))
        lines = list(self._lines)[len(self._lines) - fresh :]
        return [line.text for line in lines if line.level in _PROBLEMS]

    def as_json(self) -> list[dict[str, object]]:
        return [asdict(line) for line in self._lines]


def node_name(logger: str) -> str:
    """Full name of the node with that `logger`: `/robot/yolov5` for `robot.yolov5`."""
    return f"/{logger.replace('.', '/')}"
