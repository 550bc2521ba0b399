"""From a model to a detector: which runtime and precision, and whether this machine can pay for it."""

from __future__ import annotations

import logging
from functools import partial

from yolov5_lifecycle.detection.detector import USUAL_SOURCE_HW, Detector, check_image_size
from yolov5_lifecycle.detection.letterbox import Letterbox
from yolov5_lifecycle.models.cost import check_memory, checked_cost, size_multiple
from yolov5_lifecycle.models.model import Export, Model
from yolov5_lifecycle.quantization.calibration_file import Calibration, CalibrationError
from yolov5_lifecycle.quantization.comparison import deviation
from yolov5_lifecycle.quantization.precision_choice import Used, Wish, choose
from yolov5_lifecycle.runtimes.networks_by_shape import KEPT_PER_CAMERA, MIN_KEPT
from yolov5_lifecycle.runtimes.registry import load_export, load_runtime
from yolov5_lifecycle.runtimes.runtime import InferenceError, Runtime
from yolov5_lifecycle.runtimes.torch_device import resolve_device

_log = logging.getLogger(__name__)


def load_detector(
    model: Model | Export,
    *,
    device: str = "auto",
    precision: str = "auto",
    image_size: int = 640,
    runtime: str = "auto",
    cameras: int = 1,
    calibration: Calibration | str = "int8 was not calibrated",
) -> Detector:
    """Load a detector for `model`; the other arguments are the settings of the same names.

    Except for `cameras`: their number, which determines how many networks for input shapes are kept; and
    `calibration`: that of the model, or why there is none. With `auto` the fastest runtime is measured and
    cached, see `choose_runtime`, and so is the speed of int8, see `choose_precision`.

    A network in int8 is first compared with fp32, see `deviation`: if it differs too much, `auto` uses fp32.

    Raises DeviceError, RuntimeAbsentError, QuantizationError and, for int8 that differs from fp32,
    CalibrationError (all ValueErrors), ValueError for the image size or if the memory is too small for it,
    InferenceError when measuring fails.
    """
    if isinstance(model, Export):
        return _of_export(model, device=device, precision=precision, image_size=image_size, runtime=runtime)
    stride = size_multiple(model.architecture)
    check_image_size(image_size, stride)
    cost = checked_cost(model.architecture, image_size, is_in_memory=_is_on_cpu(runtime, device))
    frame_hw = Letterbox.fit(USUAL_SOURCE_HW, image_size=image_size, stride=stride).network_hw
    used = choose(
        model,
        Wish(device=device, runtime=runtime, precision=precision),
        calibration,
        image_size=image_size,
        frame_hw=frame_hw,
    )
    # Besides the network of every camera there are those for batches and for a camera that changes its size.
    kept = max(MIN_KEPT, KEPT_PER_CAMERA * cameras)
    used, loaded = _loaded(
        model, used, calibration, device=device, precision=precision, kept=kept, frame_hw=frame_hw
    )
    return Detector(
        loaded,
        class_names=model.class_names,
        image_size=image_size,
        stride=stride,
        choice=used.runtime.reason,
        precision_choice=used.precision.reason,
        mask_coefficients=model.architecture.mask_coefficients,
        cost=cost,
    )


def _loaded(
    model: Model,
    used: Used,
    calibration: Calibration | str,
    *,
    device: str,
    precision: str,
    kept: int,
    frame_hw: tuple[int, int],
) -> tuple[Used, Runtime]:
    """The runtime of `used`; with the `precision` auto in fp32, if int8 differs too much from that.

    Raises CalibrationError if it does and `precision` is int8, else like `load_detector`.
    """
    known = calibration if isinstance(calibration, Calibration) else None
    quantization = known.quantization if known else None
    load = partial(load_runtime, model, device=device, kept=kept, quantization=quantization)
    loaded = load(used.runtime.runtime, precision=used.precision.precision)
    if known is None or loaded.precision != "int8":
        return used, loaded
    try:
        problem = deviation(model, known, loaded, frame_hw)
    except InferenceError as error:
        problem = f"int8 cannot be compared with fp32: {error}"
    if not problem:
        return used, loaded
    loaded.close()
    if precision == "int8":
        raise CalibrationError(f"this calibration is not usable: {problem}")
    _log.warning("Running in fp32 instead of int8, because the calibration is not usable: %s", problem)
    used = used.without_int8(f"the calibration is not usable: {problem}")
    return used, load(used.runtime.runtime, precision="fp32")


def _of_export(export: Export, *, device: str, precision: str, image_size: int, runtime: str) -> Detector:
    """A detector that runs `export` as it is; a fixed size of its images must be that of `image_size`."""
    if export.size_hw and image_size != max(export.size_hw):
        height, width = export.size_hw
        raise ValueError(
            f"Image size {image_size}: this export takes images of {width}x{height} only. Set image_size to "
            f"{max(export.size_hw)}."
        )
    check_image_size(image_size, export.stride)
    from yolov5_lifecycle.checkpoints.onnx_file import export_cost  # without exports there may be no onnx

    cost = export_cost(export, export.size_hw or (image_size, image_size))
    check_memory(cost, cost.memory_bytes)
    loaded = load_export(export, runtime, device=device, precision=precision)
    return Detector(
        loaded,
        class_names=export.class_names,
        image_size=image_size,
        stride=export.stride,
        choice="as set" if runtime != "auto" else "the first that is installed and runs exports",
        precision_choice="that of the export",
        mask_coefficients=export.mask_coefficients,
        cost=cost,
        fixed_hw=export.size_hw,
    )


def _is_on_cpu(runtime: str, device: str) -> bool:
    """Whether the network will run in this machine's memory; a GPU refuses too much by itself."""
    return runtime not in ("auto", "torch") or resolve_device(device).type == "cpu"
