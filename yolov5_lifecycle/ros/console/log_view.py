"""The recent log messages of a detector."""

from __future__ import annotations

from collections import OrderedDict, deque
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass

from yolov5_lifecycle.printable import in_lines
from yolov5_lifecycle.ros.console.serialized_message import SerializedMessage

KEPT = 100
_MAX_TEXT = 4_000
"""Characters; a detector with one camera lists its settings in 2,500."""
_MAX_NAME = 300
_MAX_OTHERS = 64
"""Loggers of which no detector is known yet."""
_LEVELS = ((50, "fatal"), (40, "error"), (30, "warn"), (20, "info"))
_PROBLEMS = ("warn", "error", "fatal")


@dataclass(frozen=True)
class LogLine:
    """One message; `level` is debug, info, warn, error or fatal."""

    stamp_s: float
    level: str
    text: str

    @property
    def is_problem(self) -> bool:
        return self.level in _PROBLEMS


def read_log(content: bytes) -> tuple[str, LogLine]:
    """Logger and line of a serialized rcl_interfaces/Log, with its line breaks; raises UnreadableError."""
    message = SerializedMessage(content)
    stamp_s, number = message.time_s(), message.byte()
    logger, text = message.text(_MAX_NAME), message.text(_MAX_TEXT)
    level = next((name for least, name in _LEVELS if number >= least), "debug")
    return logger, LogLine(stamp_s, level, in_lines(text, _MAX_TEXT))


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


class Logs:
    """The recent lines of each logger, also of those whose node is not known yet: a node logs as it starts.

    `is_kept(name)`: whether a logger is that of a known detector; of the others, only the last few are kept.
    """

    def __init__(self, is_kept: Callable[[str], bool]) -> None:
        self._is_kept = is_kept
        self._views: OrderedDict[str, LogView] = OrderedDict()

    def of(self, logger: str) -> LogView:
        """The lines of a logger, the same object as long as it is kept."""
        view = self._views.setdefault(logger, LogView())
        self._views.move_to_end(logger)
        others = [name for name in self._views if not self._is_kept(name)]
        if len(others) > _MAX_OTHERS:
            del self._views[others[0]]
        return view


def logger_name(node_name: str) -> str:
    """Name of the logger of the node with the full name `node_name`: `robot.yolov5` for `/robot/yolov5`."""
    return node_name.removeprefix("/").replace("/", ".")
