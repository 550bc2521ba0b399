"""The devices on which torch runs the network: CPU and GPUs, compared with one another."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping
from types import MappingProxyType

import torch

from yolov5_lifecycle.doctor.built_in_image import COARSE, EXACT, detected, difference, truth
from yolov5_lifecycle.doctor.finding import Check, Finding, Machine, error, ok, warning
from yolov5_lifecycle.doctor.nvidia_driver import KERNEL_MODULE
from yolov5_lifecycle.printable import in_one_line
from yolov5_lifecycle.runtimes.torch_device import devices_present

_WRONG = "Install torch again; if the difference stays, set device to another one and report this line."


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
    reference = detected(runtime="torch")
    if problem := difference(truth(), reference.detections, COARSE):
        yield error(f"cpu fp32 differs from the ground truth: {problem}", remedy=_WRONG)
    else:
        count = len(reference.detections)
        yield ok(f"cpu fp32: all {count} shapes found, {reference.median_ms:.1f} ms an image")
    for device in devices_present()[1:]:
        for precision, tolerance in (("fp32", EXACT), ("fp16", COARSE)):
            result = detected(runtime="torch", device=device, precision=precision)
            if problem := difference(reference.detections, result.detections, tolerance):
                yield error(f"{device} {precision} differs from the CPU: {problem}", remedy=_WRONG)
            else:
                yield ok(
                    f"{device} {precision}: same detections as the CPU, {result.median_ms:.1f} ms an image"
                )


CHECKS: Mapping[str, Check] = MappingProxyType({"torch": _build, "forward": _forward})
