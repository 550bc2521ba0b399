"""Which precision goes with which device and runtime."""

from __future__ import annotations


def precision_rule(precision: str, *, device: str, runtime: str) -> str:
    """The rule that the three settings violate together, or ""."""
    if precision == "fp16" and device == "cpu":
        return "'fp16' needs a GPU, but device is 'cpu'. Use precision 'auto' or 'fp32'."
    if precision not in ("int8", "bf16"):
        return ""
    if device not in ("auto", "cpu"):
        return (
            f"'{precision}' runs on the CPU only, but device is '{device}'. Use device 'cpu' or precision "
            "'auto'."
        )
    if runtime not in ("auto", "openvino"):
        return (
            f"'{precision}' needs OpenVINO, but runtime is '{runtime}'. Use runtime 'auto', or precision "
            "'fp32'."
        )
    return ""
