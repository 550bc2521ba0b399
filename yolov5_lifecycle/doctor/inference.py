"""The package's own network on a synthetic image: every device and runtime must find the same objects."""

from __future__ import annotations

import statistics
import timeit
import warnings
from collections.abc import Iterator
from contextlib import closing

import numpy as np
import torch

from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.detection.nms import Selection
from yolov5_lifecycle.detection.python_api import load_model
from yolov5_lifecycle.doctor.finding import Finding, Groups, Machine, error, ok, warning
from yolov5_lifecycle.doctor.system import KERNEL_MODULE
from yolov5_lifecycle.printable import in_one_line
from yolov5_lifecycle.runtimes.cache import installed_build
from yolov5_lifecycle.runtimes.registry import REQUIREMENTS
from yolov5_lifecycle.runtimes.torch_device import devices_present
from yolov5_lifecycle.sources.scene import CLASS_NAMES, Scene

_WEIGHTS = "package://yolov5_lifecycle/weights/shapes.safetensors"
_IMAGE, _SHAPES = Scene(8, (480, 640)).frame(0)
"""RGB pixels (480, 640, 3) of six shapes."""
_TRUTH = Detections(_SHAPES.boxes_xyxy, np.ones(len(_SHAPES.class_ids), np.float32), _SHAPES.class_ids)
_RUNS = 5

EXACT = (1.0, 0.01)
"""How much the same detection may differ: in pixels of a corner, and in the score."""
COARSE = (6.0, 0.15)
"""For fp16, and for the ground truth."""


def _detected(*, runtime: str, device: str = "cpu", precision: str = "fp32") -> tuple[Detections, float]:
    """What the network finds in the image, and the median milliseconds of a detection.

    Raises what `load_model` and `Detector` raise.
    """
    detector = load_model(_WEIGHTS, runtime=runtime, device=device, precision=precision)
    with closing(detector.runtime):
        times_s = timeit.repeat(lambda: detector(_IMAGE, order="rgb"), number=1, repeat=_RUNS)
        return detector(_IMAGE, order="rgb"), 1e3 * statistics.median(times_s)


def difference(expected: Detections, found: Detections, tolerance: tuple[float, float]) -> str:
    """The first object of one that the other lacks or has elsewhere; "" if there is none.

    Objects whose scores are so near to the threshold that they may be on either side of it are left out.
    """
    most_px, most_score = tolerance
    for one, other, word in ((expected, found, "lacks"), (found, expected, "also has")):
        for box, score, class_id in zip(one.boxes_xyxy, one.scores, one.class_ids, strict=True):
            corners = np.abs(other.boxes_xyxy - box).max(axis=1, initial=0.0)
            is_same = (other.class_ids == class_id) & (corners <= most_px)
            is_same &= np.abs(other.scores - score) <= most_score
            if not is_same.any() and score > Selection().confidence_threshold + most_score:
                return f"it {word} {CLASS_NAMES[class_id]} {score:.2f} at {box.round().astype(int).tolist()}"
    return ""


def _build(machine: Machine) -> Iterator[Finding]:
    built = f"torch {torch.__version__}"
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        is_available = torch.cuda.is_available()
    if is_available:
        names = ", ".join(torch.cuda.get_device_name(index) for index in range(torch.cuda.device_count()))
        yield ok(f"{built} for CUDA {torch.version.cuda} sees {names}")
    elif not machine.path(KERNEL_MODULE).exists():
        yield ok(f"{built}, on the CPU only")
    elif torch.version.cuda is None:
        yield warning(
            f"{built} has no CUDA, so the GPU is not used",
            remedy="Install a build of torch with CUDA: `make clean`, then `make install` without TORCH=cpu; "
            "elsewhere see torch's installation page.",
        )
    else:
        reason = in_one_line(str(told[0].message), 300) if told else "torch does not say why"
        yield error(
            f"{built} for CUDA {torch.version.cuda} finds no usable GPU: {reason}",
            remedy="Update NVIDIA's driver, or install torch built for an older CUDA from its installation "
            "page; without either, set device to cpu.",
        )


def _forward(_: Machine) -> Iterator[Finding]:
    expected, median_ms = _detected(runtime="torch")
    problem = difference(_TRUTH, expected, COARSE)
    yield _compared("cpu fp32", "the ground truth", problem, f"all {len(expected)} shapes found", median_ms)
    for device in devices_present()[1:]:
        for precision, tolerance in (("fp32", EXACT), ("fp16", COARSE)):
            found, median_ms = _detected(runtime="torch", device=device, precision=precision)
            problem = difference(expected, found, tolerance)
            yield _compared(
                f"{device} {precision}", "the CPU", problem, "same detections as the CPU", median_ms
            )


def _compared(name: str, other: str, problem: str, told: str, median_ms: float) -> Finding:
    if not problem:
        return ok(f"{name}: {told}, {median_ms:.1f} ms an image")
    remedy = "Install torch again; if the difference stays, set device to another one and report this line."
    return error(f"{name} differs from {other}: {problem}", remedy=remedy)


def _runtime(machine: Machine) -> Iterator[Finding]:
    packages = REQUIREMENTS[machine.target]
    if missing := [package for package in packages if installed_build(package) is None]:
        yield ok(f"not installed ({', '.join(missing)}); the node uses another runtime")
        return
    found, median_ms = _detected(runtime=machine.target)
    expected, expected_ms = _detected(runtime="torch")
    if problem := difference(expected, found, EXACT):
        yield error(
            f"differs from torch: {problem}",
            remedy=f"Install it again with pip install --force-reinstall {' '.join(packages)}, or set "
            "runtime to torch, because `auto` may choose this one.",
        )
    else:
        yield ok(f"same detections as torch, {median_ms:.1f} ms an image (torch {expected_ms:.1f})")


CHECKS: Groups = {"devices": {"torch": _build, "forward": _forward}, "runtime": {"runtime": _runtime}}
