"""Registry of runtimes by name."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from types import MappingProxyType

from yolov5_lifecycle.models.model import Model
from yolov5_lifecycle.runtimes.cache import installed_build
from yolov5_lifecycle.runtimes.networks_by_shape import MIN_KEPT
from yolov5_lifecycle.runtimes.runtime import Runtime
from yolov5_lifecycle.runtimes.torch_runtime import TorchRuntime

REQUIREMENTS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {"torch": ("torch",), "onnxruntime": ("onnxruntime", "onnx"), "openvino": ("openvino", "onnx")}
)
"""Packages that each runtime imports; all but torch have a pip extra of the same name."""


class RuntimeAbsentError(ValueError):
    """An unknown runtime, or one that is not installed; the message says how to install it."""


def installed_runtimes() -> list[str]:
    """Names of the runtimes whose packages are installed."""
    return [name for name, packages in REQUIREMENTS.items() if all(map(installed_build, packages))]


def load_runtime(model: Model, runtime: str, *, device: str, precision: str, kept: int = MIN_KEPT) -> Runtime:
    """Load `model` in the runtime torch, onnxruntime or openvino; other arguments as in the settings.

    Of the networks for different input shapes the `kept` ones used last are kept.

    Raises RuntimeAbsentError and DeviceError, both ValueErrors.
    """
    if runtime == "torch":
        return TorchRuntime.load(model, device=device, precision=precision, kept=kept)
    if runtime not in REQUIREMENTS:
        words = ", ".join(("auto", *REQUIREMENTS))
        raise RuntimeAbsentError(f"Runtime must be one of {words}, found {runtime[:40]!r}.")
    try:
        return _load_compiled(model, runtime, device=device, precision=precision, kept=kept)
    except ImportError as error:
        problem = str(error).partition("\n")[0]
    raise RuntimeAbsentError(
        f"Runtime '{runtime}' is not installed ({problem}). Install it with "
        f"{sys.executable} -m pip install {' '.join(REQUIREMENTS[runtime])}, or use 'auto'."
    )


def _load_compiled(model: Model, runtime: str, *, device: str, precision: str, kept: int) -> Runtime:
    """Load an ONNX engine, imported here because its packages are optional. Raises ImportError."""
    for package in REQUIREMENTS[runtime]:
        if installed_build(package) is None:  # importing an unrelated folder of that name would succeed
            raise ImportError(f"there is no package {package}")
    from yolov5_lifecycle.runtimes.compiled_runtime import CompiledRuntime

    if runtime == "onnxruntime":
        from yolov5_lifecycle.runtimes.onnxruntime_runtime import onnxruntime_engine as engine
    else:
        from yolov5_lifecycle.runtimes.openvino_runtime import openvino_engine as engine
    return CompiledRuntime.load(model, engine(), device=device, precision=precision, kept=kept)
