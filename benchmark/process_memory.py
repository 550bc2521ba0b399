"""Memory and processor time of processes as reported by Linux."""

from __future__ import annotations

import os
import resource
from pathlib import Path


def resident_mb(process_id: int) -> float:
    """Resident memory of the process."""
    return _status_mb(process_id, "VmRSS")


def peak_resident_mb(process_id: int) -> float:
    """Peak resident memory since the process start or `forget_peak`."""
    return _status_mb(process_id, "VmHWM")


def proportional_mb(process_id: int) -> float:
    """Resident memory with each page divided by the number of processes that share it (PSS).

    The sum over processes counts every page once.
    """
    lines = Path(f"/proc/{process_id}/smaps_rollup").read_text().splitlines()
    (kilobytes,) = (line.split()[1] for line in lines if line.startswith("Pss:"))
    return int(kilobytes) / 1024


def forget_peak() -> None:
    """Reset the peak of this process to its current resident memory."""
    Path("/proc/self/clear_refs").write_text("5")


def limit_growth(growth_mb: float) -> None:
    """Let this process map at most `growth_mb` besides what it has mapped by now.

    What the imports map is not counted because it depends on the build: torch for CUDA alone maps 3.2 GB.
    Beyond the limit an allocation fails, in Python with MemoryError.
    """
    limit_bytes = int((_status_mb(os.getpid(), "VmSize") + growth_mb) * 1024**2)
    resource.setrlimit(resource.RLIMIT_AS, (limit_bytes, limit_bytes))


def cpu_s(process_id: int) -> float:
    """User and system time of the process so far, all threads together."""
    fields = Path(f"/proc/{process_id}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _status_mb(process_id: int, entry: str) -> float:
    lines = Path(f"/proc/{process_id}/status").read_text().splitlines()
    (kilobytes,) = (line.split()[1] for line in lines if line.startswith(f"{entry}:"))
    return int(kilobytes) / 1024
