"""Problems of settings that contradict each other or the machine."""

from __future__ import annotations

from yolov5_lifecycle.settings.schema import Problem


def precision_rule(precision: str, *, device: str, runtime: str) -> str:
    """The rule that precision, device and runtime violate together, or ""."""
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


def not_above(name: str, value: float, bound: str, most: float) -> Problem:
    """The setting `name` must not be above the setting `bound`, whose value is `most`."""
    return Problem(name, f"{value:g} is above {bound}, {most:g}. Lower it, or raise the other.")


def without_scipy(tracker: str, absence: str) -> Problem:
    """The `tracker` needs scipy, of which `absence` says why it cannot be used and how to install it."""
    reason = f"'{tracker}' needs scipy. {absence.rstrip('.')}, or use the tracker 'none'."
    return Problem("tracker", reason)


def without_folder() -> Problem:
    """Images cannot be collected without a folder, which only the start of the process can name."""
    return Problem("collect", "true needs a folder. Restart the node with collect_dir set to one.")
