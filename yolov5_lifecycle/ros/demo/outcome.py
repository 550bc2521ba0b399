"""Result of a demonstration: a table and a summary, or the problems."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass


class DemonstrationError(RuntimeError):
    """The detector misbehaved; the message describes the expected and the actual behaviour."""


@dataclass(frozen=True)
class Outcome:
    """A demonstration that ran to its end; `problems` are the figures that are worse than required."""

    table: str
    summary: str
    problems: tuple[str, ...] = ()


def aligned(rows: Sequence[Sequence[str]]) -> str:
    """Table of `rows`, the first of them the header; all columns but the first are right-aligned."""
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    lines = [
        "  ".join([row[0].ljust(widths[0]), *map(str.rjust, row[1:], widths[1:])]).rstrip() for row in rows
    ]
    return "\n".join(["", lines[0], "-" * len(lines[0]), *lines[1:], ""])
