"""The cameras of a detector as the page shows them, from its diagnostics."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

from yolov5_lifecycle.printable import in_lines, in_one_line
from yolov5_lifecycle.ros.console.serialized_message import SerializedMessage
from yolov5_lifecycle.settings.camera_names import MAX_CAMERAS, NODE_STATUS

_BALANCE = "frames "
LOSSES = ("frames lost", "frames overtaken")
"""Images that were sent but not received, so not part of the balance."""
_MAX_TEXT = 5_000
_MAX_VALUES = 100
_MAX_STATUSES = MAX_CAMERAS + 1
_MAX_LENGTH = 200_000
"""Characters of all values of a detector; with 16 cameras they have 20,000."""
_MAX_NAME = 300
_STALE = 3
_MAX_DIGITS = 18
"""Of a number of frames; Python raises ValueError for thousands of them."""
_NOTHING_TO_TELL = "detecting"


@dataclass(frozen=True)
class StatusView:
    """One status of /diagnostics. `name`: of the camera, or NODE_STATUS; `level`: 0 (OK) to 3 (stale)."""

    name: str
    level: int
    message: str
    values: Mapping[str, str]

    @property
    def as_lost(self) -> StatusView:
        """The same when no more come, as the detector is lost."""
        return replace(self, level=_STALE)

    def as_json(self) -> dict[str, object]:
        return {
            "name": self.name,
            "level": self.level,
            "message": self.message,
            "values": dict(self.values),
        }

    def number(self, key: str) -> float | None:
        """The value of `key` as a finite number; None if it has none."""
        try:
            number = float(self.values[key])
        except (KeyError, ValueError):
            return None
        return number if math.isfinite(number) else None

    @property
    def balance(self) -> dict[str, int]:
        """Number of frames by outcome; `received` is their sum."""
        return {
            key.removeprefix(_BALANCE): int(value)
            for key, value in self.values.items()
            if key.startswith(_BALANCE) and key not in LOSSES and _is_count(value)
        }


def read_statuses(content: bytes) -> Iterator[tuple[str, StatusView]]:
    """Node and status of each status of a serialized diagnostic_msgs/DiagnosticArray, made printable.

    Ends after the most statuses that a detector has, and with one that has more than 100 values or makes the
    text longer than _MAX_LENGTH. Raises UnreadableError.
    """
    message = SerializedMessage(content)
    message.time_s(), message.text(0)
    length = 0
    for _ in range(min(message.count(), _MAX_STATUSES)):
        level, name = min(message.byte(), _STALE), message.text(_MAX_NAME)
        text, node = message.text(_MAX_TEXT), message.text(_MAX_NAME)
        count, values = message.count(), dict[str, str]()
        for _ in range(min(count, _MAX_VALUES)):
            key = in_one_line(message.text(200), 200)
            values[key] = in_lines(message.text(_MAX_TEXT), _MAX_TEXT)
            length += len(key) + len(values[key])
            if length > _MAX_LENGTH:
                break
        shown = in_one_line(name.rpartition(": ")[2], 200)
        yield node, StatusView(shown, level, in_lines(text, _MAX_TEXT), values)
        if count > _MAX_VALUES or length > _MAX_LENGTH:
            return


def _is_count(text: str) -> bool:
    return text.isascii() and text.isdigit() and len(text) <= _MAX_DIGITS


@dataclass(frozen=True)
class CameraView:
    """A camera; `name` is "" for the one without a name. `status` is None until diagnostics arrive."""

    name: str
    status: StatusView | None

    def as_json(self, *, is_lost: bool = False) -> dict[str, object]:
        """What the page shows of it; of a camera of a lost detector, no figures."""
        status = self.status
        if status is None or is_lost:
            return {"name": self.name, "rate_hz": None, "latency_ms": None, "latency_p95_ms": None} | {
                "balance": status.balance if status is not None else {},
                "message": "",
                "level": _STALE if is_lost else 0,
            }
        return {
            "name": self.name,
            "rate_hz": status.number("rate Hz"),
            "latency_ms": status.number("latency median ms"),
            "latency_p95_ms": status.number("latency p95 ms"),
            "balance": status.balance,
            "message": "" if status.message == _NOTHING_TO_TELL else status.message,
            "level": status.level,
        }


def camera_views(names: Sequence[str], statuses: Sequence[StatusView]) -> list[CameraView]:
    """The cameras called `names` with their status among `statuses`; without names, the only camera."""
    by_name = {status.name: status for status in statuses}
    if not names:
        return [CameraView("", by_name.get(NODE_STATUS))]
    return [CameraView(name, by_name.get(name)) for name in names]
