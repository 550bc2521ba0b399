"""Registry of runtimes by name."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from types import MappingProxyType
from typing import Final

import torch

from yolov5_lifecycle.models.model import Model
from yolov5_lifecycle.runtimes.cache import installed_build
from yolov5_lifecycle.runtimes.networks_by_shape import MIN_KEPT
from yolov5_lifecycle.runtimes.processor_abilities import abilities, has_bf16
from yolov5_lifecycle.runtimes.quantization import Quantization, QuantizationError
from yolov5_lifecycle.runtimes.runtime import Runtime
from yolov5_lifecycle.runtimes.torch_device import DeviceError, resolve_precision
from yolov5_lifecycle.runtimes.torch_runtime import TorchRuntime

REQUIREMENTS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {"torch": ("torch",), "onnxruntime": ("onnxruntime", "onnx"), "openvino": ("openvino", "onnx")}
)
"""Packages that each runtime imports; all but torch have a pip extra of the same name."""


COARSE_RUNTIME: Final = "openvino"
"""The runtime for the precisions in COARSE; ONNX Runtime is slower in int8 than in fp32."""
COARSE = ("int8", "bf16")
"""CPU precisions that are faster than fp32."""


class RuntimeAbsentError(ValueError):
    """An unknown runtime, or one that is not installed; the message says how to install it."""


def installed_runtimes() -> list[str]:
    """Names of the runtimes whose packages are installed."""
    return [name for name, packages in REQUIREMENTS.items() if all(map(installed_build, packages))]


def load_runtime(
    model: Model,
    runtime: str,
    *,
    device: str,
    precision: str,
    kept: int = MIN_KEPT,
    quantization: Quantization | None = None,
) -> Runtime:
    """Load `model` in the runtime torch, onnxruntime or openvino; other arguments as in the settings.

    Precision int8 needs a `quantization`. The `kept` most recently used networks for different input shapes
    are kept.

    Raises RuntimeAbsentError, DeviceError and QuantizationError, all ValueErrors.
    """
    if precision in COARSE:
        _check_coarse(runtime, precision, quantization)
    if runtime == "torch":
        return TorchRuntime.load(model, device=device, precision=precision, kept=kept)
    if runtime not in REQUIREMENTS:
        words = ", ".join(("auto", *REQUIREMENTS))
        raise RuntimeAbsentError(f"Runtime must be one of {words}, found {runtime[:40]!r}.")
    try:
        return _load_compiled(
            model, runtime, device=device, precision=precision, kept=kept, quantization=quantization
        )
    except ImportError as error:
        problem = str(error).partition("\n")[0]
    raise RuntimeAbsentError(
        f"Runtime '{runtime}' is not installed ({problem}). Install it with "
        f"{sys.executable} -m pip install {' '.join(REQUIREMENTS[runtime])}, or use 'auto'."
    )


def _check_coarse(runtime: str, precision: str, quantization: Quantization | None) -> None:
    """Raise DeviceError or QuantizationError unless `runtime` computes `precision` here."""
    if runtime != COARSE_RUNTIME:
        raise DeviceError(
            f"Precision '{precision}' needs runtime '{COARSE_RUNTIME}', found {runtime[:40]!r}. Use that "
            "runtime or 'auto', or precision 'fp32'."
        )
    if precision == "bf16" and not has_bf16(found := abilities()):
        raise DeviceError(
            "Precision 'bf16' needs a processor with AVX512-BF16 or AMX, found one with "
            f"{', '.join(found) or 'neither'}. Use precision 'auto' or 'fp32'."
        )
    if precision == "int8" and quantization is None:
        raise QuantizationError(
            "Precision 'int8' needs a calibration of these weights; see `calibrate --help`."
        )


def _load_compiled(
    model: Model,
    runtime: str,
    *,
    device: str,
    precision: str,
    kept: int,
    quantization: Quantization | None,
) -> Runtime:
    """Load an ONNX engine, imported here because its packages are optional. Raises ImportError."""
    for package in REQUIREMENTS[runtime]:
        if installed_build(package) is None:  # importing an unrelated folder of that name would succeed
            raise ImportError(f"package {package} not found")
    from yolov5_lifecycle.runtimes.compiled_runtime import CompiledRuntime

    if precision not in COARSE:
        resolve_precision(precision, torch.device("cpu"))
        precision, quantization = "fp32", None
    if runtime == "onnxruntime":
        from yolov5_lifecycle.runtimes.onnxruntime_runtime import onnxruntime_engine

        engine = onnxruntime_engine()
    else:
        from yolov5_lifecycle.runtimes.openvino_runtime import openvino_engine

        engine = openvino_engine(precision)
    return CompiledRuntime.load(
        model, engine, device=device, quantization=quantization if precision == "int8" else None, kept=kept
    )
