"""What other programs do to this machine while a test measures time."""

from __future__ import annotations

import os
import time
from collections.abc import Iterable
from pathlib import Path

_TICKS = os.sysconf("SC_CLK_TCK")


class MachineLoad:
    """Watches from birth on; `process_ids` are the processes that are no others."""

    def __init__(self, process_ids: Iterable[int]) -> None:
        self._process_ids = tuple(process_ids)
        self._begun_s = time.monotonic()
        self._others_s = self._others_cpu_s()

    @property
    def others_cores(self) -> float:
        """How many cores others have kept busy, or a hypervisor has kept for itself, on average."""
        return (self._others_cpu_s() - self._others_s) / (time.monotonic() - self._begun_s)

    def _others_cpu_s(self) -> float:
        return _machine_cpu_s() - sum(map(_process_cpu_s, self._process_ids))


def _machine_cpu_s() -> float:
    """Busy time of all cores: user, nice, system, irq, softirq and steal of /proc/stat."""
    ticks = [int(word) for word in Path("/proc/stat").read_text().splitlines()[0].split()[1:9]]
    idle = ticks[3] + ticks[4]
    return (sum(ticks) - idle) / _TICKS


def _process_cpu_s(process_id: int) -> float:
    fields = Path(f"/proc/{process_id}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / _TICKS
