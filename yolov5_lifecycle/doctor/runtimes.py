"""A runtime besides torch: the same detections, and the precisions that only it computes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from types import MappingProxyType

from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.doctor.built_in_image import COARSE, EXACT, detected, difference
from yolov5_lifecycle.doctor.finding import Check, Finding, Machine, error, ok, warning
from yolov5_lifecycle.printable import in_one_line
from yolov5_lifecycle.quantization.calibration_file import CalibrationError
from yolov5_lifecycle.runtimes.cache import installed_build
from yolov5_lifecycle.runtimes.processor_abilities import abilities, has_bf16, weight_bits
from yolov5_lifecycle.runtimes.registry import COARSE_RUNTIME, REQUIREMENTS


def _runtime(machine: Machine) -> Iterator[Finding]:
    packages = REQUIREMENTS[machine.target]
    if missing := [package for package in packages if installed_build(package) is None]:
        yield ok(f"not installed ({', '.join(missing)}); the node uses another runtime")
        return
    install = f"Install it again with pip install --force-reinstall {' '.join(packages)}"
    try:
        found = detected(runtime=machine.target)
    except Exception as refusal:  # noqa: BLE001 - a broken package raises anything
        cause = refusal.__cause__ or refusal  # what the package raised; the refusal repeats the remedy
        yield error(
            in_one_line(f"{type(cause).__name__}: {cause}", 400),
            remedy=f"{install}; until then `auto` leaves it out.",
        )
        return
    expected = detected(runtime="torch")
    if problem := difference(expected.detections, found.detections, EXACT):
        remedy = f"{install}, or set runtime to torch, because `auto` may choose this one."
        yield error(f"differs from torch: {problem}", remedy=remedy)
    else:
        yield ok(
            f"same detections as torch, {found.median_ms:.1f} ms an image (torch {expected.median_ms:.1f})"
        )


def _precisions(machine: Machine) -> Iterator[Finding]:
    if machine.target != COARSE_RUNTIME or installed_build(COARSE_RUNTIME) is None:
        return
    expected = detected(runtime=COARSE_RUNTIME)
    gain = f"fp32 {expected.median_ms:.1f} ms"
    yield _precision("int8", expected.detections, gain)
    if weight_bits(abilities()) == 7:
        yield ok("int8 on this processor gains little, because it has no VNNI")
    if has_bf16(abilities()):
        yield _precision("bf16", expected.detections, gain)
    else:
        yield ok("bf16 is not computed by this processor")


def _precision(precision: str, expected: Detections, fp32: str) -> Finding:
    remedy = f"Keep precision at auto or fp32, because {precision} is not usable here; docs/int8.md has more."
    try:
        found = detected(runtime=COARSE_RUNTIME, precision=precision)
    except CalibrationError as refusal:
        return warning(f"{precision}: {refusal}", remedy=remedy)
    if problem := difference(expected, found.detections, COARSE):
        return warning(f"{precision} differs from fp32: {problem}", remedy=remedy)
    return ok(f"{precision}: same detections as fp32, {found.median_ms:.1f} ms an image ({fp32})")


CHECKS: Mapping[str, Check] = MappingProxyType({"runtime": _runtime, "precisions": _precisions})
