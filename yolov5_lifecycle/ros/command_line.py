"""What stands on a node's command line besides ROS's own arguments: explained, never ignored."""

from __future__ import annotations

import sys
from collections.abc import Sequence

_HELP = {"-h", "--help"}


def complain(command: str, problem: object) -> int:
    """Say why `command` cannot start; the exit code for it."""
    sys.stderr.write(f"{command}: {problem}\n")
    return 2


def explain(
    command: str,
    words: Sequence[str],
    *,
    usage: str,
    parameters: Sequence[tuple[str, str | None, object]],
) -> int:
    """Answer `words` with `usage` and `parameters` (name, description, default); the exit code for them."""
    unknown = [word for word in words if word not in _HELP]
    width = max(len(name) for name, *_ in parameters)
    rows = [
        f"  {name:{width}}  {description} Default: {default!r}" for name, description, default in parameters
    ]
    stream = sys.stderr if unknown else sys.stdout
    stream.write("\n".join([usage, *rows, ""]))
    return complain(command, f"arguments not understood: {' '.join(unknown)}") if unknown else 0
