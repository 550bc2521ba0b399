"""Problems of settings that contradict each other or the machine."""

from __future__ import annotations

from yolov5_lifecycle.settings.schema import Problem


def not_above(name: str, value: float, bound: str, most: float) -> Problem:
    """The setting `name` must not be above the setting `bound`, whose value is `most`."""
    return Problem(name, f"{value:g} is above {bound}, {most:g}. Lower it, or raise the other.")


def without_scipy(tracker: str, absence: str) -> Problem:
    """The `tracker` needs scipy, of which `absence` says why it cannot be used and how to install it."""
    reason = f"'{tracker}' needs scipy. {absence.rstrip('.')}, or use the tracker 'none'."
    return Problem("tracker", reason)
