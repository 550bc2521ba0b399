"""The processor: what it is called, and which precisions besides fp32 it computes quickly."""

from __future__ import annotations

import platform
from functools import cache
from pathlib import Path
from typing import Literal

_TOLD = (
    *("avx2", "avx512f", "avx_vnni", "avx512_vnni", "avx512_bf16", "amx_int8", "amx_bf16"),
    *("asimddp", "i8mm", "bf16"),
)
_INTEGER_PRODUCTS = {"avx_vnni", "avx512_vnni", "amx_int8"}
_BFLOAT16 = {"avx512_bf16", "amx_bf16"}
_X86 = ("x86_64", "AMD64")
# In /proc/cpuinfo: CPU model and features, on x86 and ARM.
_RELEVANT_FIELDS = ("model name", "flags", "Features", "CPU implementer", "CPU part")


def processor() -> str:
    """Architecture, model name (if available) and features of the CPU."""
    try:
        first, *_ = Path("/proc/cpuinfo").read_text(errors="replace").split("\n\n")
    except OSError:  # not Linux
        return f"{platform.machine()} {platform.processor()}"
    relevant = [line for line in first.splitlines() if line.startswith(_RELEVANT_FIELDS)]
    return "\n".join([platform.machine(), *relevant])


@cache
def abilities(described: str | None = None) -> tuple[str, ...]:
    """Instruction sets that matter for int8 and bf16, in a fixed order.

    `described`: the result of `processor`, by default for this machine.
    """
    words = set((processor() if described is None else described).split())
    return tuple(name for name in _TOLD if name in words)


def weight_bits(found: tuple[str, ...], machine: str = platform.machine()) -> Literal[7, 8]:
    """Bits of a quantized weight that do not overflow: 7 on x86 without VNNI, else 8.

    Without VNNI, two 8-bit products are added in 16 bits, with saturation.
    """
    return 7 if machine in _X86 and not _INTEGER_PRODUCTS & set(found) else 8


def has_bf16(found: tuple[str, ...]) -> bool:
    """Whether the processor multiplies bfloat16, rather than emulating it."""
    return bool(_BFLOAT16 & set(found))
