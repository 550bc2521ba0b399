"""The cameras of a detector as the page shows them, from its diagnostics."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from diagnostic_msgs.msg import DiagnosticStatus

from yolov5_lifecycle.printable import in_lines, in_one_line
from yolov5_lifecycle.settings.camera_names import NODE_STATUS

_BALANCE = "frames "
LOSSES = ("frames lost", "frames overtaken")
"""Images that were sent but not received, so not part of the balance."""
_MAX_TEXT = 5_000
_MAX_VALUES = 100
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

    @classmethod
    def of(cls, status: DiagnosticStatus) -> StatusView:
        """The view of `status`, made printable."""
        return cls(
            name=in_one_line(status.name.rpartition(": ")[2], 200),
            level=min(ord(status.level), 3),
            message=in_lines(status.message, _MAX_TEXT),
            values={
                in_one_line(item.key, 200): in_lines(item.value, _MAX_TEXT)
                for item in status.values[:_MAX_VALUES]
            },
        )

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


def _is_count(text: str) -> bool:
    return text.isascii() and text.isdigit() and len(text) <= _MAX_DIGITS


@dataclass(frozen=True)
class CameraView:
    """A camera; `name` is "" for the one without a name. `status` is None until diagnostics arrive."""

    name: str
    status: StatusView | None

    def as_json(self) -> dict[str, object]:
        status = self.status
        if status is None:
            return {"name": self.name, "rate_hz": None, "latency_ms": None, "latency_p95_ms": None} | {
                "balance": {},
                "message": "",
                "level": 0,
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
