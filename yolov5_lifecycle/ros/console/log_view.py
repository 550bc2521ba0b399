"""The recent log messages of a detector."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import asdict, dataclass

from rcl_interfaces.msg import Log

from yolov5_lifecycle.printable import in_lines

KEPT = 100
_MAX_TEXT = 2_000
_LEVELS = ((50, "fatal"), (40, "error"), (30, "warn"), (20, "info"))
_PROBLEMS = ("warn", "error", "fatal")


@dataclass(frozen=True)
class LogLine:
    """One message; `level` is debug, info, warn, error or fatal."""

    stamp_s: float
    level: str
    text: str

    @classmethod
    def of(cls, message: Log) -> LogLine:
        number = ord(message.level) if isinstance(message.level, bytes) else int(message.level)
        level = next((name for least, name in _LEVELS if number >= least), "debug")
        stamp_s = message.stamp.sec + message.stamp.nanosec * 1e-9
        return cls(stamp_s, level, in_lines(message.msg, _MAX_TEXT))

    @property
    def is_problem(self) -> bool:
        return self.level in _PROBLEMS


class LogView:
    """The last KEPT lines."""

    def __init__(self) -> None:
        self._lines: deque[LogLine] = deque(maxlen=KEPT)
        self.count = 0
        """Number of lines so far, including those no longer kept."""

    def add(self, line: LogLine) -> None:
        self._lines.append(line)
        self.count += 1

    def problems_since(self, count: int) -> Iterator[LogLine]:
        """The problems among the lines after the first `count`."""
        fresh = min(self.count - count, len(self._lines))
        lines = list(self._lines)[len(self._lines) - fresh :]
        return (line for line in lines if line.is_problem)

    def as_json(self) -> list[dict[str, object]]:
        return [asdict(line) for line in self._lines]


def logger_name(node_name: str) -> str:
    """Name of the logger of the node with the full name `node_name`: `robot.yolov5` for `/robot/yolov5`."""
    return node_name.removeprefix("/").replace("/", ".")
