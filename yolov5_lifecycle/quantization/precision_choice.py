"""Whether `precision: auto` is int8: only if its calibration says it is good, and it is faster here."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import torch

from yolov5_lifecycle.models.model import Model
from yolov5_lifecycle.quantization.calibration_file import Calibration, Measurement
from yolov5_lifecycle.quantization.comparison import MAX_NOISE
from yolov5_lifecycle.runtimes.auto import (
    Choice,
    choice_key,
    choose_runtime,
    computer_digest,
    read_figures,
    write_figures,
)
from yolov5_lifecycle.runtimes.cache import cache_folder
from yolov5_lifecycle.runtimes.processor_abilities import abilities, weight_bits
from yolov5_lifecycle.runtimes.quantization import QuantizationError
from yolov5_lifecycle.runtimes.registry import COARSE, COARSE_RUNTIME, installed_runtimes
from yolov5_lifecycle.runtimes.runtime import InferenceError
from yolov5_lifecycle.runtimes.speed import INT8_FIGURES, measure_int8_ms
from yolov5_lifecycle.runtimes.torch_device import resolve_device

MIN_SPEEDUP = 1.15
MIN_AGREEMENT = 0.98
MAX_MAP_LOSS = 1.0
MIN_DETECTIONS = 50


@dataclass(frozen=True)
class PrecisionChoice:
    """fp32 or int8, and the reason."""

    precision: str
    reason: str


@dataclass(frozen=True)
class Wish:
    """The settings of the same names."""

    device: str
    runtime: str
    precision: str


@dataclass(frozen=True)
class Used:
    """What runs the network, and in which precision."""

    runtime: Choice
    precision: PrecisionChoice
    in_fp32: Choice
    """The runtime if int8 turns out to be unusable."""

    def without_int8(self, reason: str) -> Used:
        """In fp32 instead."""
        return Used(self.in_fp32, PrecisionChoice("fp32", reason), self.in_fp32)


def choose(
    model: Model,
    wish: Wish,
    calibration: Calibration | str,
    *,
    image_size: int,
    frame_hw: tuple[int, int],
) -> Used:
    """Runtime and precision for `wish`; `calibration`: the model's, or why there is none.

    Raises DeviceError, and InferenceError when measuring fails.
    """
    if wish.precision in COARSE:
        runtime = COARSE_RUNTIME if wish.runtime == "auto" else wish.runtime
        reason = "as set" if wish.runtime == runtime else f"the only one for {wish.precision}"
        choice = Choice(runtime, reason)
        return Used(choice, PrecisionChoice(wish.precision, "as set"), choice)
    choice = Choice(wish.runtime, "as set")
    if wish.runtime == "auto":
        choice = choose_runtime(model, device=wish.device, precision=wish.precision, frame_hw=frame_hw)
    if wish.precision != "auto":
        return Used(choice, PrecisionChoice(wish.precision, "as set"), choice)
    device = resolve_device(wish.device) if choice.runtime == "torch" else torch.device("cpu")
    if device.type != "cpu":
        return Used(choice, PrecisionChoice("auto", f"that of {device.type}"), choice)
    if isinstance(calibration, str):
        return Used(choice, PrecisionChoice("fp32", calibration), choice)
    precision = choose_precision(
        model,
        calibration,
        runtime=choice.runtime,
        is_free=wish.runtime == "auto",
        image_size=image_size,
        frame_hw=frame_hw,
    )
    in_fp32 = choice
    if precision.precision == "int8" and choice.runtime != COARSE_RUNTIME:
        choice = Choice(COARSE_RUNTIME, f"the only one for int8; in fp32: {choice.runtime}, {choice.reason}")
    return Used(choice, precision, in_fp32)


def choose_precision(
    model: Model,
    calibration: Calibration,
    *,
    runtime: str,
    is_free: bool,
    image_size: int,
    frame_hw: tuple[int, int],
    folder: Path | None = None,
    measure: Callable[..., dict[str, float]] = measure_int8_ms,
) -> PrecisionChoice:
    """int8 if it is good according to `calibration` and faster here than fp32, else fp32.

    `runtime`: that of fp32; `is_free`: whether int8 may use another one. The speed is the one that
    `calibrate` measured on this computer. Only without one, it is measured once and kept with the choice of
    the runtime, in `folder`.
    """
    problem = _absence(runtime, is_free=is_free) or quality_problem(calibration, image_size=image_size)
    if problem:
        return PrecisionChoice("fp32", problem)
    in_fp32 = {each.runtime for each in calibration.measured if each.precision == "fp32"}
    if runtime in in_fp32 and calibration.computer_sha256 == computer_digest():
        return choice_of(calibration, *(() if is_free else (runtime,)))
    try:
        figures_ms, origin = _figures_ms(
            model, calibration, runtime=runtime, frame_hw=frame_hw, folder=folder, measure=measure
        )
    except (QuantizationError, InferenceError) as error:
        return PrecisionChoice("fp32", f"int8 cannot be used: {error}")
    return _of_speed(figures_ms, origin, calibration)


def choice_of(calibration: Calibration, *runtimes: str) -> PrecisionChoice:
    """The choice by what `calibrate` measured: int8 beside the fastest fp32 (in `runtimes`, default: all).

    int8 must have been measured, and fp32 in one of `runtimes`.
    """
    in_fp32 = [
        each
        for each in calibration.measured
        if each.precision == "fp32" and (not runtimes or each.runtime in runtimes)
    ]
    fp32 = min(in_fp32, key=lambda each: each.ms_per_image)
    int8 = _of_int8(calibration)
    figures_ms = (
        *(fp32.ms_per_image, int8.ms_per_image),
        *(fp32.processor_ms_per_image, int8.processor_ms_per_image),
    )
    return _of_speed(dict(zip(INT8_FIGURES, figures_ms, strict=True)), "measured by calibrate", calibration)


def quality_problem(calibration: Calibration, *, image_size: int) -> str:
    """Why int8 is not known to be good on this processor at `image_size`, or ""."""
    measured = calibration.measurement(COARSE_RUNTIME, "int8")
    bits = weight_bits(abilities())
    if measured is None:
        return "int8 was not measured when the weights were calibrated"
    if calibration.image_size != image_size:
        return (
            f"int8 was measured at image_size {calibration.image_size}, not {image_size}: calibrate with "
            f"--image-size {image_size}"
        )
    if calibration.weight_bits != bits:
        return (
            f"int8 was measured with weights of {calibration.weight_bits} bits, this processor needs {bits}: "
            "calibrate on it"
        )
    if calibration.detections < MIN_DETECTIONS:
        return (
            f"only {calibration.detections} detections were compared with fp32, which is less than "
            f"{MIN_DETECTIONS}: calibrate with other or more images"
        )
    if measured.agreement_f1 < MIN_AGREEMENT:
        return (
            f"int8 agrees with fp32 to {measured.agreement_f1:.3f} (F1), which is less than {MIN_AGREEMENT:g}"
        )
    if measured.map_loss is not None and measured.map_loss > MAX_MAP_LOSS:
        return f"int8 loses {measured.map_loss:.1f} points of mAP, which is more than {MAX_MAP_LOSS:g}"
    if max(calibration.reference.noise) > MAX_NOISE:
        return "int8 differs from fp32 too much on the reference image: calibrate with other or more images"
    return ""


def _absence(runtime: str, *, is_free: bool) -> str:
    if not is_free and runtime != COARSE_RUNTIME:
        return f"int8 needs runtime '{COARSE_RUNTIME}', and '{runtime}' is set"
    return "" if COARSE_RUNTIME in installed_runtimes() else f"int8 needs {COARSE_RUNTIME}, not installed"


def _of_int8(calibration: Calibration) -> Measurement:
    measured = calibration.measurement(COARSE_RUNTIME, "int8")
    assert measured is not None
    return measured


def _of_speed(figures_ms: Mapping[str, float], origin: str, calibration: Calibration) -> PrecisionChoice:
    fp32_ms, int8_ms, fp32_processor_ms, int8_processor_ms = (figures_ms[name] for name in INT8_FIGURES)
    speedup, saving = fp32_ms / int8_ms, fp32_processor_ms / int8_processor_ms
    told = (
        f"int8 is {speedup:.2f} x as fast as fp32 here ({int8_ms:.1f} ms, not {fp32_ms:.1f}; {saving:.2f} x "
        f"by processor time; {origin}) and agrees with it to {_of_int8(calibration).agreement_f1:.3f} (F1)"
    )
    if min(speedup, saving) < MIN_SPEEDUP:
        return PrecisionChoice("fp32", f"{told}; int8 is used from {MIN_SPEEDUP:g} x by both times")
    return PrecisionChoice("int8", told)


def _figures_ms(
    model: Model,
    calibration: Calibration,
    *,
    runtime: str,
    frame_hw: tuple[int, int],
    folder: Path | None,
    measure: Callable[..., dict[str, float]],
) -> tuple[dict[str, float], str]:
    """Milliseconds in fp32 and in int8, and where they come from."""
    quantization = calibration.quantization
    key = choice_key(model, installed_runtimes(), frame_hw, "int8", runtime, quantization.digest)
    record = (folder or cache_folder("choices")) / f"{key}.json"
    if (kept_ms := read_figures(record, INT8_FIGURES, required=INT8_FIGURES)) is not None:
        return kept_ms, f"cached in {record}, delete this file to measure again"
    figures_ms = measure(model, runtime, quantization, frame_hw=frame_hw)
    return figures_ms, write_figures(record, figures_ms) or "measured now"
