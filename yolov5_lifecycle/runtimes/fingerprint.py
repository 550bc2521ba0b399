"""Fingerprint of installed packages and CPU, for the keys of cached timings and compiled models."""

from __future__ import annotations

import platform
from importlib.util import find_spec
from pathlib import Path

# In /proc/cpuinfo: CPU model and features, on x86 and ARM.
_RELEVANT_FIELDS = ("model name", "flags", "Features", "CPU implementer", "CPU part")


def installed_build(package: str) -> str | None:
    """File and modification time of what `import package` would load; differs between versions.

    Independent of the distribution: onnxruntime may come from onnxruntime-gpu. None when the package is
    missing or only a folder of that name.
    """
    spec = find_spec(package)
    if spec is None or spec.origin is None:
        return None
    return f"{spec.origin} {Path(spec.origin).stat().st_mtime_ns}"


def processor() -> str:
    """Architecture, model name (if available) and features of the CPU."""
    try:
        first, *_ = Path("/proc/cpuinfo").read_text(errors="replace").split("\n\n")
    except OSError:  # not Linux
        return f"{platform.machine()} {platform.processor()}"
    relevant = [line for line in first.splitlines() if line.startswith(_RELEVANT_FIELDS)]
    return "\n".join([platform.machine(), *relevant])
