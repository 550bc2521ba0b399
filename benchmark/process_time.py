"""Process CPU time as reported by Linux."""

from __future__ import annotations

import os
from pathlib import Path


def cpu_s(process_id: int) -> float:
    """User and system time of the process so far, all threads together."""
    fields = Path(f"/proc/{process_id}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
