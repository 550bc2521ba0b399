"""Names of cameras, which become parts of topic names and prefixes of parameter names."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Collection, Sequence

MAX_CAMERAS = 16
MAX_LENGTH = 64
"""Max characters of a name."""

_NAME = re.compile(r"[A-Za-z](_?[A-Za-z0-9])*_?")
_TOPICS = ("image", "image_raw", "detections", "detections_3d", "label_info")
NODE_STATUS = "detection"
"""What the status of the node in /diagnostics is called, beside those of its cameras."""
_FOREIGN = ("qos_overrides", "use_sim_time", "start_type_description_service")
"""Beginnings of the names of parameters that ROS itself declares on every node."""


def camera_names_rule(names: Sequence[str], settings: Collection[str]) -> str:
    """What `names` must be but are not, or an empty string; `settings` are the names of the settings."""
    for name in names:
        if len(name) > MAX_LENGTH or not _NAME.fullmatch(name):
            return (
                f"must be names of at most {MAX_LENGTH} letters, digits and single underscores that begin "
                f"with a letter: rename {_shown(name)}."
            )
        if name in settings or name in (*_TOPICS, NODE_STATUS) or name.startswith(_FOREIGN):
            return f"must not hold {name!r}, the name of {_taken_by(name, settings)}: rename that camera."
    if repeated := [name for name, count in Counter(names).items() if count > 1]:
        return f"must name each camera once: leave out one {repeated[0]!r}."
    return ""


def _taken_by(name: str, settings: Collection[str]) -> str:
    if name in settings:
        return "a setting"
    if name == NODE_STATUS:
        return "the status of the node in /diagnostics"
    return "a topic" if name in _TOPICS else "a parameter of ROS"


def _shown(name: str) -> str:
    return repr(name) if len(name) <= MAX_LENGTH else f"{name[:MAX_LENGTH]!r}..."
