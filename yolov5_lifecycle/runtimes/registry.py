"""Registry of runtimes by name."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Final

import torch

from yolov5_lifecycle.models.model import Export, Model
from yolov5_lifecycle.printable import shell_command
from yolov5_lifecycle.runtimes.networks_by_shape import MIN_KEPT
from yolov5_lifecycle.runtimes.processor import abilities, has_bf16
from yolov5_lifecycle.runtimes.quantization import Quantization, QuantizationError
from yolov5_lifecycle.runtimes.runtime import Runtime
from yolov5_lifecycle.runtimes.torch_device import DeviceError, resolve_precision
from yolov5_lifecycle.runtimes.torch_runtime import TorchRuntime

if TYPE_CHECKING:
    from yolov5_lifecycle.runtimes.compiled_runtime import Engine

REQUIREMENTS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {"torch": ("torch",), "onnxruntime": ("onnxruntime", "onnx"), "openvino": ("openvino", "onnx")}
)
"""Packages that each runtime imports; all but torch have a pip extra of the same name."""


_FOR_EXPORTS = ("onnxruntime", "openvino")
COARSE_RUNTIME: Final = "openvino"
"""The runtime for the precisions in COARSE; ONNX Runtime is slower in int8 than in fp32."""
COARSE = ("int8", "bf16")
"""CPU precisions that are faster than fp32."""


_MAX_PROBLEM = 200


def installed_runtimes() -> list[str]:
    """Names of the runtimes whose packages are installed."""
    return [name for name, packages in REQUIREMENTS.items() if all(map(installed_build, packages))]


def installed_build(package: str) -> str | None:
    """File and modification time of what `import package` would load; differs between versions.

    Independent of the distribution: onnxruntime may come from onnxruntime-gpu. None when the package is
    missing or only a folder of that name.
    """
    spec = find_spec(package)
    if spec is None or spec.origin is None:
        return None
    return f"{spec.origin} {Path(spec.origin).stat().st_mtime_ns}"


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

    Raises DeviceError, also for an absent runtime, and QuantizationError, all ValueErrors.
    """
    if precision in COARSE:
        _check_coarse(runtime, precision, quantization)
    if runtime == "torch":
        return TorchRuntime.load(model, device=device, precision=precision, kept=kept)
    if runtime not in REQUIREMENTS:
        words = ", ".join(("auto", *REQUIREMENTS))
        raise DeviceError(f"Runtime must be one of {words}, found {runtime[:40]!r}.")
    if precision not in COARSE:
        resolve_precision(precision, torch.device("cpu"))
        precision = "fp32"
    engine = imported_engine(runtime, precision)
    from yolov5_lifecycle.runtimes.compiled_runtime import CompiledRuntime, Compiler, Threads, check_processor

    check_processor(device, engine)
    compiler = Compiler(model, engine, quantization if precision == "int8" else None)
    return CompiledRuntime(compiler, Threads(), kept=kept)


def load_export(export: Export, runtime: str, *, device: str, precision: str) -> Runtime:
    """Load `export` in the runtime onnxruntime or openvino; `auto` is the first of them that is installed.

    Raises DeviceError, also for an absent runtime; InferenceError if the runtime cannot load it.
    """
    if precision not in ("auto", export.precision):
        raise DeviceError(
            f"Precision '{precision[:40]}' needs the layers of the network, but an export to ONNX is run as "
            f"it is, this one in {export.precision}. Use precision 'auto', or the .pt."
        )
    if runtime == "auto":
        present = [name for name in _FOR_EXPORTS if name in installed_runtimes()]
        runtime = (present or _FOR_EXPORTS)[0]
    if runtime not in _FOR_EXPORTS:
        raise DeviceError(
            f"Runtime {runtime[:40]!r} cannot run an export to ONNX, which is run as it is. Use runtime "
            "'auto', 'onnxruntime' or 'openvino', or the .pt."
        )
    engine = imported_engine(runtime, "fp32")
    from yolov5_lifecycle.runtimes.exported_runtime import load_exported

    return load_exported(export, engine, device=device)


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


def imported_engine(runtime: str, precision: str) -> Engine:
    """The engine of `runtime`. Raises DeviceError.

    Imported here because the packages are optional. A package that does not fit another one, such as numpy,
    may raise anything.
    """
    try:
        for package in REQUIREMENTS[runtime]:
            if installed_build(package) is None:  # importing an unrelated folder of that name would succeed
                raise ImportError(f"package {package} not found")
        return _engine(runtime, precision)
    except ImportError as error:
        raise _absent(runtime, "is not installed", str(error)) from error
    except Exception as error:
        problem = f"{type(error).__name__}: {error}"
        raise _absent(runtime, "cannot be imported", problem, "--force-reinstall") from error


def _engine(runtime: str, precision: str) -> Engine:
    """The engine of `runtime`, with `precision` where there is a choice. Raises what the import raises."""
    if runtime == "onnxruntime":
        from yolov5_lifecycle.runtimes.onnxruntime_runtime import onnxruntime_engine

        return onnxruntime_engine()
    from yolov5_lifecycle.runtimes.openvino_runtime import openvino_engine

    return openvino_engine(precision)


def _absent(runtime: str, state: str, problem: str, *flags: str) -> DeviceError:
    install = shell_command(sys.executable, "-m", "pip", "install", *flags, *REQUIREMENTS[runtime])
    return DeviceError(
        f"Runtime '{runtime}' {state} ({problem.partition(chr(10))[0][:_MAX_PROBLEM]}). Install it with "
        f"{install}, or use 'auto'."
    )
