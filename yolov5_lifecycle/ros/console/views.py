"""Messages and parameters of a detector as the page shows them, printable and bounded; its values for ROS."""

from __future__ import annotations

import json
import math
from collections import deque
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rcl_interfaces.msg import Log, ParameterType, ParameterValue
from rcl_interfaces.msg import Parameter as ParameterMessage
from rclpy.parameter import Parameter, parameter_value_to_python
from vision_msgs.msg import LabelInfo

from yolov5_lifecycle.printable import in_lines, in_one_line, printable
from yolov5_lifecycle.ros.parameters.declaration import TYPES
from yolov5_lifecycle.settings.camera_overrides import MAX_CAMERAS
from yolov5_lifecycle.settings.schema import Setting
from yolov5_lifecycle.settings.settings import SCHEMA

KEPT_LINES = 100
STALE = 3
_MAX_NAME, _MAX_TEXT, _MAX_VALUES = 200, 5_000, 100
_MAX_LINE = 4_000
"""Characters of a message of the log; a detector with one camera lists its settings in 2,500."""
_MAX_CLASSES = 10_000
_NOTHING_TO_TELL = "detecting"
_LEVELS = ((50, "fatal"), (40, "error"), (30, "warn"), (20, "info"))
_PROBLEMS = ("warn", "error", "fatal")
_INTEGERS = range(-(2**63), 2**63)
_MAX_LENGTH = 1 << 20
"""Characters and entries of lists of all values of a detector that are shown."""


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


def parameters_as_json(values: Mapping[str, ParameterValue]) -> dict[str, dict[str, object]]:
    """The settings among parameters with their `values`, by name.

    A `value` of null is not set if `is_shown`; else it is of another type than the setting, not finite, or
    all that are shown would have more than _MAX_LENGTH.
    """
    found, length = dict[str, dict[str, object]](), 0
    for name, value in values.items():
        if setting := SCHEMA.find(name):
            plain = plain_value(value) if value.type == TYPES[setting.type].value else None
            is_shown = plain is not None or value.type == ParameterType.PARAMETER_NOT_SET
            if length + _length(plain) > _MAX_LENGTH:
                plain, is_shown = None, False
            length += _length(plain)
            found[name] = _as_json(setting) | {"value": plain, "is_shown": is_shown}
    return found


def _as_json(setting: Setting) -> dict[str, object]:
    has_range = setting.minimum is not None and setting.maximum is not None
    limits = {"from": setting.minimum, "to": setting.maximum, "step": setting.step or 0}
    return {
        "name": setting.name,
        "type": TYPES[setting.type].name.lower(),
        "default": setting.default,
        "description": setting.description,
        "constraints": setting.allowed,
        "range": limits if has_range else None,
        "choices": setting.choices or None,
        "change": setting.change.name.lower(),
    }


def plain_value(value: ParameterValue) -> object:
    """`value` for JSON, printable; None if it is not set or not finite."""
    plain: object = parameter_value_to_python(value)
    if isinstance(plain, float):
        return plain if math.isfinite(plain) else None
    if isinstance(plain, (list, tuple)):
        return list(map(printable, plain))
    return printable(plain) if isinstance(plain, str) else plain


def _length(plain: object) -> int:
    texts = plain if isinstance(plain, list) else [plain] if isinstance(plain, str) else []
    return len(texts) + sum(map(len, texts))


def parameter_message(name: str, value: Any) -> ParameterMessage:
    """The parameter `name` with `value` of JSON, which the node converts to its type; null deletes it.

    Raises ValueError for the user if no parameter can have this name or value.
    """
    if not _is_text(name):
        raise ValueError(f"{in_one_line(name, 100)}: expected the name of a parameter")
    if isinstance(value, list) and all(map(_is_text, value)):
        return Parameter(name, Parameter.Type.STRING_ARRAY, value).to_parameter_msg()
    is_number = isinstance(value, int) and value in _INTEGERS
    if not (value is None or is_number or isinstance(value, float) or _is_text(value)):
        shown = in_one_line(json.dumps(value), 100)
        expected = "true, false, a number of 64 bits, a string, or a list of strings"
        raise ValueError(f"{in_one_line(name, 100)}: expected {expected}, found {shown}")
    return Parameter(name, value=value).to_parameter_msg()


def _is_text(value: object) -> bool:
    """Whether `value` is a string that ROS can send: without NUL, which would end it, or half characters."""
    return isinstance(value, str) and not any(c == "\0" or "\ud800" <= c <= "\udfff" for c in value)
