"""The report: lines of text or JSON, without private names."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence

from yolov5_lifecycle.commands.command_line import version_line
from yolov5_lifecycle.doctor.finding import Finding, Line
from yolov5_lifecycle.doctor.private_names import without_private_names
from yolov5_lifecycle.printable import in_one_line

_LEVEL, _SUBJECT = 8, 20  # columns


def public(line: Line) -> Line:
    """The line without names of people and machines, as one line of printable text."""
    subject, (level, *texts) = line.subject, (line.finding.level, line.finding.found, line.finding.remedy)
    found, remedy = (in_one_line(without_private_names(text)) for text in texts)
    return Line(in_one_line(subject), Finding(level, found, remedy))


def as_text(line: Line) -> str:
    """The line, and below it the remedy."""
    finding = line.finding
    text = f"{finding.level:<{_LEVEL}} {line.subject:<{_SUBJECT}} {finding.found}"
    return f"{text}\n{' ' * (_LEVEL + 1)}-> {finding.remedy}" if finding.remedy else text


def summary(lines: Sequence[Line], duration_s: float) -> str:
    """How many lines there are of each level."""
    levels = Counter(line.finding.level for line in lines)
    return f"{levels['ok']} ok, {levels['warning']} warnings, {levels['error']} errors in {duration_s:.0f} s"


def as_json(lines: Sequence[Line], duration_s: float) -> str:
    """All lines as one JSON object."""
    rows = [
        {"subject": subject, "level": each.level, "found": each.found, "remedy": each.remedy}
        for subject, each in lines
    ]
    content = {"version": version_line("doctor"), "duration_s": round(duration_s, 1), "lines": rows}
    return json.dumps(content, indent=2, ensure_ascii=False)
