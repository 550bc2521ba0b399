"""What measured figures and compiled models are good for: the packages and the processor that are here."""

from __future__ import annotations

import platform
from importlib.util import find_spec
from pathlib import Path

# In /proc/cpuinfo: names and abilities, of x86 and of ARM.
_TELLING = ("model name", "flags", "Features", "CPU implementer", "CPU part")


def installed_build(package: str) -> str | None:
    """What `import package` would run: its file and when that was written; another version differs.

    It does not matter which distribution it is from: onnxruntime may be from onnxruntime-gpu. None when there
    is none, or only a folder of that name.
    """
    spec = find_spec(package)
    if spec is None or spec.origin is None:
        return None
    return f"{spec.origin} {Path(spec.origin).stat().st_mtime_ns}"


def processor() -> str:
    """The processor's name, as far as it has one, and what it can compute."""
    try:
        first, *_ = Path("/proc/cpuinfo").read_text(errors="replace").split("\n\n")
    except OSError:  # not Linux
        return f"{platform.machine()} {platform.processor()}"
    told = [line for line in first.splitlines() if line.startswith(_TELLING)]
    return "\n".join([platform.machine(), *told])
