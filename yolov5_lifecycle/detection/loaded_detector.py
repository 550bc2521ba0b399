"""From a model to a detector: which runtime and precision, and whether this machine can pay for it."""

from __future__ import annotations

from yolov5_lifecycle.detection.detector import USUAL_SOURCE_HW, Detector, check_image_size
from yolov5_lifecycle.detection.letterbox import Letterbox
from yolov5_lifecycle.models.cost import check_memory, checked_cost, size_multiple
from yolov5_lifecycle.models.model import Export, Model
from yolov5_lifecycle.runtimes.networks_by_shape import KEPT_PER_CAMERA, MIN_KEPT
from yolov5_lifecycle.runtimes.quantization import Quantization
from yolov5_lifecycle.runtimes.registry import load_export, load_runtime
from yolov5_lifecycle.runtimes.speed import Choice, choose_runtime
from yolov5_lifecycle.runtimes.torch_device import resolve_device


class FixedSizeError(ValueError):
    """An export takes images of another size only; `image_size` is the setting for it."""

    def __init__(self, wanted: int, size_hw: tuple[int, int]) -> None:
        self.image_size = max(size_hw)
        super().__init__(
            f"Image size {wanted}: this export takes images of {size_hw[1]}x{size_hw[0]} only. Set "
            f"image_size to {self.image_size}."
        )


def load_detector(
    model: Model | Export,
    *,
    device: str = "auto",
    precision: str = "auto",
    image_size: int = 640,
    runtime: str = "auto",
    cameras: int = 1,
    quantization: Quantization | None = None,
) -> Detector:
    """Load a detector for `model`; the other arguments are the settings of the same names.

    Except for `cameras`: their number, which determines how many networks for input shapes are kept; and
    `quantization`, which precision int8 needs. With runtime `auto` the fastest is measured and cached, see
    `choose_runtime`.

    Raises DeviceError and QuantizationError (both ValueErrors), ValueError for the image
    size or if the memory is too small for it, InferenceError when measuring fails.
    """
    if isinstance(model, Export):
        return _of_export(model, device=device, precision=precision, image_size=image_size, runtime=runtime)
    stride = size_multiple(model.architecture)
    check_image_size(image_size, stride)
    # A GPU refuses too much by itself.
    is_on_cpu = runtime not in ("auto", "torch") or resolve_device(device).type == "cpu"
    cost = checked_cost(model.architecture, image_size, is_in_memory=is_on_cpu)
    choice = Choice(runtime, "as set")
    if runtime == "auto":
        frame_hw = Letterbox.fit(USUAL_SOURCE_HW, image_size=image_size, stride=stride).network_hw
        choice = choose_runtime(model, device=device, precision=precision, frame_hw=frame_hw)
    # Besides the network of every camera there are those for batches and for a camera that changes its size.
    kept = max(MIN_KEPT, KEPT_PER_CAMERA * cameras)
    return Detector(
        load_runtime(
            model,
            choice.runtime,
            device=device,
            precision=precision,
            kept=kept,
            quantization=quantization,
        ),
        class_names=model.class_names,
        image_size=image_size,
        stride=stride,
        choice=choice.reason,
        mask_coefficients=model.architecture.mask_coefficients,
        cost=cost,
    )


def _of_export(export: Export, *, device: str, precision: str, image_size: int, runtime: str) -> Detector:
    """A detector that runs `export` as it is; a fixed size of its images must be that of `image_size`."""
    if export.size_hw and image_size != max(export.size_hw):
        raise FixedSizeError(image_size, export.size_hw)
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
        mask_coefficients=export.mask_coefficients,
        cost=cost,
        fixed_hw=export.size_hw,
    )
