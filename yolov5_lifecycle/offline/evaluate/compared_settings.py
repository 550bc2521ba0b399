"""What a model is compared with: other weights, or the same with other settings."""

from __future__ import annotations

import re

from yolov5_lifecycle.settings.parameter_file import string_assignment

_BETWEEN_ASSIGNMENTS = re.compile(r",(?=[a-z_0-9]+=)")
_ASSIGNMENT = re.compile(r"[a-z_0-9]+=")


def compared_settings(other: str) -> list[str]:
    """Assignments `name=value` of `other`: `name=value[,name=value]`, or the path of a weights file.

    A file whose name looks like an assignment is given as `./name=value.pt`.
    """
    if _ASSIGNMENT.match(other):
        return _BETWEEN_ASSIGNMENTS.split(other)
    return [string_assignment("weights", other)]
