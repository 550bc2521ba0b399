"""Result of a trial, as a row of a table and as JSON."""

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
    """One claim, how it was tested, the result, and the limit that decides."""

    claim: str
    done: str
    result: str
    limit: str
    is_met: bool


def found(name: str, trial: Callable[[], Finding]) -> Finding:
    """Run the trial `name`; one that raises an exception counts as failed, with the reason."""
    try:
        return trial()
    except Exception as error:  # noqa: BLE001 - reported in the table; the other trials still run
        traceback.print_exc()
        first_line = str(error).partition("\n")[0]
        return Finding(name, "broken off", f"{type(error).__name__}: {first_line}", "none", False)


def problem(trial: Callable[[], None]) -> str:
    """Why one trial of many failed, "" if it passed; the others continue."""
    try:
        trial()
    except (AssertionError, RuntimeError, TimeoutError) as error:
        traceback.print_exc()
        return f"{type(error).__name__}: {error}"
    return ""


def number_of(what: str, cases: Sequence[str]) -> str:
    """The number of cases of `what`, with the first."""
    return f"{len(cases)} {what}" + (f" (first: {cases[0].partition(chr(10))[0][:200]})" if cases else "")


def table(findings: Sequence[Finding]) -> str:
    """All findings in columns, one per line."""
    rows = [_HEADS, *map(_cells, findings)]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = [
        " | ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
        for row in rows
    ]
    return "\n".join([lines[0], "-+-".join("-" * width for width in widths), *lines[1:]])


def write_report(path: Path, options: Mapping[str, object], findings: Sequence[Finding]) -> None:
    """Write all findings so far as JSON, with the options, time and machine."""
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
