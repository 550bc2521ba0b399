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
from yolov5_lifecycle.runtimes.registry import REQUIREMENTS, installed_build
from yolov5_lifecycle.runtimes.torch_device import devices_present
from yolov5_lifecycle.sources.scene import CLASS_NAMES, Scene

_WEIGHTS = "package://yolov5_lifecycle/weights/shapes.safetensors"
_IMAGE, _SHAPES = Scene(8, (480, 640)).frame(0)
"""RGB pixels (480, 640, 3) of six shapes."""
_TRUTH = Detections(_SHAPES.boxes_xyxy, np.ones(len(_SHAPES.class_ids), np.float32), _SHAPES.class_ids)
_RUNS = 5

MOST_PX, MOST_SCORE = 6.0, 0.15
"""How much a detection may differ from the ground truth: a corner of its box, and its score."""


def difference(expected: Detections, found: Detections) -> str:
    """The first object of one that the other lacks or has elsewhere; "" if there is none.

    Objects whose scores are so near to the threshold that they may be on either side of it are left out.
    """
    for one, other, word in ((expected, found, "lacks"), (found, expected, "also has")):
        for box, score, class_id in zip(one.boxes_xyxy, one.scores, one.class_ids, strict=True):
            corners = np.abs(other.boxes_xyxy - box).max(axis=1, initial=0.0)
            is_same = (other.class_ids == class_id) & (corners <= MOST_PX)
            is_same &= np.abs(other.scores - score) <= MOST_SCORE
            if not is_same.any() and score > Selection().confidence_threshold + MOST_SCORE:
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
    remedy = "Install torch again; if that does not help, set device to another one and report this line."
    yield _detected(remedy, runtime="torch")
    for device in devices_present()[1:]:
        for precision in ("fp32", "fp16"):
            yield _detected(remedy, runtime="torch", device=device, precision=precision)


def _runtime(machine: Machine) -> Iterator[Finding]:
    packages = REQUIREMENTS[machine.target]
    if missing := [package for package in packages if installed_build(package) is None]:
        yield ok(f"not installed ({', '.join(missing)}); the node uses another runtime")
        return
    remedy = (
        f"Install it again with pip install --force-reinstall {' '.join(packages)}, or set runtime to torch, "
        "because `auto` may choose this one."
    )
    yield _detected(remedy, runtime=machine.target)


def _detected(remedy: str, *, runtime: str, device: str = "cpu", precision: str = "fp32") -> Finding:
    """What the network finds in the image, and how fast; raises what `load_model` and `Detector` raise."""
    detector = load_model(_WEIGHTS, runtime=runtime, device=device, precision=precision)
    with closing(detector.runtime):
        times_s = timeit.repeat(lambda: detector(_IMAGE, channel_order="rgb"), number=1, repeat=_RUNS)
        problem = difference(_TRUTH, detector(_IMAGE, channel_order="rgb"))
    if problem:
        return error(f"{device} {precision} differs from the ground truth: {problem}", remedy=remedy)
    median_ms = 1e3 * statistics.median(times_s)
    return ok(f"{device} {precision}: all {len(_TRUTH.scores)} shapes found, {median_ms:.1f} ms an image")


CHECKS: Groups = {"devices": {"torch": _build, "forward": _forward}, "runtime": {"runtime": _runtime}}
