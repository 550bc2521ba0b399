"""What a process holds of the machine's memory, as Linux counts it."""

from __future__ import annotations

from pathlib import Path


def resident_mb(process_id: int) -> float:
    """The memory that the process has in RAM."""
    return _status_mb(process_id, "VmRSS")


def peak_resident_mb(process_id: int) -> float:
    """The most that it had, since its start or since `forget_peak`."""
    return _status_mb(process_id, "VmHWM")


def forget_peak() -> None:
    """From now on, the peak of this very process is what it has from now on."""
    Path("/proc/self/clear_refs").write_text("5")


def _status_mb(process_id: int, entry: str) -> float:
    lines = Path(f"/proc/{process_id}/status").read_text().splitlines()
    (kilobytes,) = (line.split()[1] for line in lines if line.startswith(f"{entry}:"))
    return int(kilobytes) / 1024
