"""What a trial found, as a row of a table and as a file."""

from __future__ import annotations

import dataclasses
import json
import os
import platform
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path

_HEADS = ("claim", "what was done", "result", "limit", "ok")


@dataclass(frozen=True)
class Finding:
    """One claim, what was done to shake it, what came of that, and the limit that decides."""

    claim: str
    done: str
    result: str
    limit: str
    is_met: bool


def found(name: str, trial: Callable[[], Finding]) -> Finding:
    """What the trial `name` finds; one that cannot go on has failed, and says why."""
    try:
        return trial()
    except Exception as error:  # noqa: BLE001 - told in the table; the other trials are still worth their time
        traceback.print_exc()
        first_line = str(error).partition("\n")[0]
        return Finding(name, "broken off", f"{type(error).__name__}: {first_line}", "none", False)


def problem(trial: Callable[[], None]) -> str:
    """Why one trial of many has failed, "" when it has not; the others go on."""
    try:
        trial()
    except (AssertionError, RuntimeError, TimeoutError) as error:
        traceback.print_exc()
        return f"{type(error).__name__}: {error}"
    return ""


def number_of(what: str, cases: Sequence[str]) -> str:
    """How many cases there were of `what`, and the first."""
    return f"{len(cases)} {what}" + (f" (first: {cases[0].partition(chr(10))[0][:200]})" if cases else "")


def table(findings: Sequence[Finding]) -> str:
    """All findings, one a line, in columns."""
    rows = [_HEADS, *map(_cells, findings)]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = [
        " | ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
        for row in rows
    ]
    return "\n".join([lines[0], "-+-".join("-" * width for width in widths), *lines[1:]])


def write_report(path: Path, options: Mapping[str, object], findings: Sequence[Finding]) -> None:
    """All findings so far as JSON, with what was asked for, when and where."""
    report = {
        "written": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        "options": dict(options),
        "machine": {"cores": os.cpu_count(), "system": platform.platform()},
        "findings": [dataclasses.asdict(finding) for finding in findings],
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(report, indent=2) + "\n", encoding="utf-8")


def _cells(finding: Finding) -> tuple[str, ...]:
    return (
        finding.claim,
        finding.done,
        finding.result,
        finding.limit,
        "yes" if finding.is_met else "NO",
    )
