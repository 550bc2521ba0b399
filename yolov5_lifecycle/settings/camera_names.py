"""Names of cameras, which become parts of topic names and prefixes of parameter names."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Collection, Sequence
from itertools import islice

from yolov5_lifecycle.settings.schema import SEPARATOR
from yolov5_lifecycle.settings.synonyms import ROS_PREFIXES

MAX_CAMERAS = 16
MAX_NAME_LENGTH = 64
"""Max characters of a name."""

_NAME = re.compile(r"[A-Za-z](_?[A-Za-z0-9])*_?")
_TOPICS = ("image", "image_raw", "detections", "detections_3d", "masks", "label_info")
"""First parts of the names of the node's own topics; `depth` is a setting, too."""
NODE_STATUS = "detection"
"""Name of the node's own status in /diagnostics, beside those of its cameras."""


def camera_names_rule(names: Sequence[str], settings: Collection[str]) -> str:
    """The first rule that `names` violate, or an empty string; `settings` are the names of the settings."""
    for name in names:
        if len(name) > MAX_NAME_LENGTH or not _NAME.fullmatch(name):
            return (
                f"must be names of at most {MAX_NAME_LENGTH} letters, digits and single underscores that "
                f"begin with a letter: rename {_shown(name)}."
            )
        if owner := _owner(name, settings):
            return f"must not hold {name!r}, the name of {owner}: rename that camera."
    if repeated := [name for name, count in Counter(names).items() if count > 1]:
        return f"must name each camera once: leave out one {repeated[0]!r}."
    return ""


def usable_names(value: object) -> tuple[str, ...]:
    """The first MAX_CAMERAS valid names in `value`, an invalid list of cameras or a string meant as one."""
    if isinstance(value, str):
        value = [name.strip(" \"'") for name in value.strip(" []").split(",")]
    if not isinstance(value, (list, tuple)):
        return ()
    names = dict.fromkeys(name for name in value if isinstance(name, str))
    valid = (name for name in names if not camera_names_rule([name], ()))
    return tuple(islice(valid, MAX_CAMERAS))


def _owner(name: str, settings: Collection[str]) -> str:
    """What is already called `name`, or an empty string."""
    if name in settings:
        return "a setting"
    if name in _TOPICS:
        return "a topic"
    if name == NODE_STATUS:
        return "the status of the node in /diagnostics"
    return "a parameter of ROS" if f"{name}{SEPARATOR}".startswith(ROS_PREFIXES) else ""


def _shown(name: str) -> str:
    return repr(name) if len(name) <= MAX_NAME_LENGTH else f"{name[:MAX_NAME_LENGTH]!r}..."
