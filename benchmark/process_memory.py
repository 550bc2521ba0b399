"""Process memory as reported by Linux."""

from __future__ import annotations

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


def _status_mb(process_id: int, entry: str) -> float:
    lines = Path(f"/proc/{process_id}/status").read_text().splitlines()
    (kilobytes,) = (line.split()[1] for line in lines if line.startswith(f"{entry}:"))
    return int(kilobytes) / 1024
