"""What measured figures and compiled models are good for: the packages and the processor that are here."""

from __future__ import annotations

import platform
from importlib.util import find_spec
from pathlib import Path


def installed_build(package: str) -> str | None:
    """What `import package` would run: its file and when that was written; another version differs.

    It does not matter which distribution it is from: onnxruntime may be from onnxruntime-gpu. None when there
    is none, or only a folder of that name.
    """
    spec = find_spec(package)
    if spec is None or spec.origin is None:
        return None
    return f"{spec.origin} {Path(spec.origin).stat().st_mtime_ns}"


def cpu_model() -> str:
    """The processor's name."""
    try:
        lines = Path("/proc/cpuinfo").read_text(errors="replace").splitlines()
    except OSError:  # not Linux
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()
