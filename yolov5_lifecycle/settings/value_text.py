"""Values of parameters in messages, spelled as in YAML: `true`, not `True`."""

from __future__ import annotations

import math
from collections.abc import Iterable

from yolov5_lifecycle.printable import MAX_LINE, without_secrets

MAX_SHOWN = 100
"""Max characters of a value or an unknown name shown in a message."""


def value_text(value: object) -> str:
    """`value` as a parameter file and `ros2 param set` write it: true, null, .inf, 0.5, ['front', 'rear']."""
    if isinstance(value, (str, bytes)):
        return repr(value)
    if isinstance(value, Iterable):
        return f"[{', '.join(map(value_text, value))}]"
    if value is None:
        return "null"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, float) and not math.isfinite(value):
        return ".nan" if math.isnan(value) else ".inf" if value > 0 else "-.inf"
    return repr(value)


def shown_value(value: object) -> str:
    """`value_text` of a value, truncated to MAX_SHOWN characters; takes bounded time."""
    if isinstance(value, (list, tuple)):
        text = value_text([_beginning(entry) for entry in value[:MAX_SHOWN]])
    else:
        text = value_text(_beginning(value))
    return text if len(text) <= MAX_SHOWN else text[: MAX_SHOWN - 3] + "..."


def _beginning(value: object) -> object:
    return without_secrets(value[:MAX_LINE])[: MAX_SHOWN + 1] if isinstance(value, str) else value
