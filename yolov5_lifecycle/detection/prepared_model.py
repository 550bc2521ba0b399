"""From settings to a loaded and warmed-up model."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from yolov5_lifecycle.checkpoints.locate import WeightsFile, confined, find_weights, load_weights
from yolov5_lifecycle.detection.detector import USUAL_SOURCE_HW, Detector, check_image_size
from yolov5_lifecycle.detection.letterbox import Letterbox
from yolov5_lifecycle.detection.stream_choice import InferenceStreams, choose_streams, processors
from yolov5_lifecycle.input_file import resolve_package
from yolov5_lifecycle.models.cost import check_memory, checked_cost, size_multiple
from yolov5_lifecycle.models.model import Export, Model
from yolov5_lifecycle.process.memory import release_unused_memory
from yolov5_lifecycle.quantization.calibration_file import find_quantization
from yolov5_lifecycle.runtimes.networks_by_shape import KEPT_PER_CAMERA, MIN_KEPT
from yolov5_lifecycle.runtimes.quantization import Quantization
from yolov5_lifecycle.runtimes.registry import load_export, load_runtime
from yolov5_lifecycle.runtimes.runtime_choice import Choice, choose_runtime
from yolov5_lifecycle.runtimes.torch_device import resolve_device
from yolov5_lifecycle.settings.schema import Change
from yolov5_lifecycle.settings.settings import MAX_PARALLEL_FRAMES, Settings

FileVersion = tuple[int, int, int, int]
"""What tells a file from another that takes its place, and from itself once it is written again."""


@dataclass(frozen=True)
class PreparedModel:
    """A warmed-up detector with its settings and weights file."""

    settings: Settings
    detector: Detector
    weights_path: Path
    weights_sha256: str
    streams: InferenceStreams = field(default_factory=InferenceStreams)
    """For frames of different cameras at the same time; `detector` is for a frame without others."""
    file_version: FileVersion | None = None
    """Of the weights file when it was read; None if nobody looked."""

    @property
    def facts(self) -> dict[str, str]:
        """Resolved weights, runtime, device and precision, for log and diagnostics."""
        coefficients = self.detector.mask_coefficients
        runtime = self.detector.runtime
        facts = {
            "weights": str(self.weights_path),
            "sha256": self.weights_sha256,
            "classes": str(len(self.detector.class_names)),
            "masks": f"{coefficients} coefficients" if coefficients else "",
            "runtime": runtime.name,
            "runtime choice": self.detector.choice,
            "device": runtime.device,
            "precision": runtime.precision,
            "cost": str(self.detector.cost or ""),
            "parallel frames": self.streams.reason,
        }
        return {name: value for name, value in facts.items() if value}

    def serves(self, settings: Settings) -> bool:
        """Whether this model serves `settings` without a reload."""
        return not self.settings.differing(settings, Change.RELOAD)

    def is_outdated(self) -> bool:
        """Whether the weights file is no longer the one that was read: replaced, written again, or gone."""
        return self.file_version is not None and _file_version(self.settings) != self.file_version

    @property
    def summary(self) -> str:
        """`facts` on one line."""
        return ", ".join(f"{name} {value}" for name, value in self.facts.items())

    def close(self, *, is_at_rest: bool = True) -> None:
        """Free the model and return its memory to the system.

        Unless it `is_at_rest`, memory is not returned: on a GPU that would wait for the hanging frame.
        No reference cycle holds a network, so no gc run is needed; one would stop all threads for 0.15 s.
        """
        self.streams.close()
        self.detector.close()
        if is_at_rest:
            release_unused_memory()


Prepare = Callable[[Settings, Sequence[tuple[int, int]]], PreparedModel]
"""See `prepare_model`."""


def prepare_model(settings: Settings, sizes_hw: Sequence[tuple[int, int]]) -> PreparedModel:
    """Find, load and build the model that `settings` select, and warm it up.

    `sizes_hw`: height and width of the images of each camera, equal ones repeated.

    Raises ValueError (WeightsError, DeviceError) or OSError with a message for the user.
    """
    version = _file_version(settings)  # before it is read: what is written meanwhile makes it outdated
    weights = load_weights(weights_path(settings), sha256=settings.weights_sha256)
    detector = load_detector(
        weights.content,
        runtime=settings.runtime,
        device=settings.device,
        precision=settings.precision,
        image_size=settings.image_size,
        cameras=len(sizes_hw),
        quantization=_quantization(weights, settings),
    )
    try:
        _warm_up(detector, sizes_hw)
        is_asked = settings.parallel_frames > 0
        streams = choose_streams(detector, sizes_hw, most=most_streams(settings), is_asked=is_asked)
    except BaseException:  # its traceback keeps the detector alive
        detector.close()
        raise
    return PreparedModel(settings, detector, weights.path, weights.sha256, streams, version)


def _file_version(settings: Settings) -> FileVersion | None:
    """Of the weights file that `settings` select; None if there is none."""
    try:
        status = weights_path(settings).stat()
    except (OSError, ValueError):
        return None
    return status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns


def _quantization(weights: WeightsFile, settings: Settings) -> Quantization | None:
    """That of the calibration beside `weights`, which int8 needs; an export refuses int8 by itself."""
    if settings.precision != "int8" or isinstance(weights.content, Export):
        return None
    allowed = partial(confined, folders=_folders(settings)) if settings.weights_dirs else None
    return find_quantization(weights, image_size=settings.image_size, allowed=allowed)


def _warm_up(detector: Detector, sizes_hw: Sequence[tuple[int, int]]) -> None:
    """Warm up for one size of network input after the other, each only if it still fits into the memory."""
    for size_hw in {detector.network_hw(size_hw): size_hw for size_hw in sizes_hw}.values():
        if detector.cost is not None and detector.runtime.device == "cpu":  # a GPU checks its own memory
            check_memory(detector.cost, detector.cost.activation_bytes)
        detector.warm_up([size_hw])


def most_streams(settings: Settings) -> int:
    """How many frames at most are in progress at the same time with `settings` on this machine."""
    wanted = settings.parallel_frames or MAX_PARALLEL_FRAMES
    return min(wanted, len(settings.camera_names), processors())


def weights_path(settings: Settings) -> Path:
    """Path of the weights file that `settings` select; raises ValueError."""
    return find_weights(
        weights=resolve_package(settings.weights),
        weights_dir=Path(resolve_package(settings.weights_dir)),
        model_size=settings.model_size,
        weights_dirs=_folders(settings),
    )


def check_place(settings: Settings) -> None:
    """Raise ValueError if the weights path is outside `weights_dirs`; does not search for the file."""
    if folders := _folders(settings):
        confined(Path(resolve_package(settings.weights or settings.weights_dir)), folders)


def _folders(settings: Settings) -> list[Path]:
    return [Path(resolve_package(folder)) for folder in settings.weights_dirs]


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
    choice = _choice(model, runtime, device=device, precision=precision, image_size=image_size)
    return Detector(
        load_runtime(
            model,
            choice.runtime,
            device=device,
            precision=precision,
            # Besides the network of every camera there is that of one that changes its size.
            kept=max(MIN_KEPT, KEPT_PER_CAMERA * cameras),
            quantization=quantization,
        ),
        class_names=model.class_names,
        image_size=image_size,
        stride=stride,
        choice=choice.reason,
        mask_coefficients=model.architecture.mask_coefficients,
        cost=cost,
    )


def _choice(model: Model, runtime: str, *, device: str, precision: str, image_size: int) -> Choice:
    """`runtime`, or for `auto` the fastest one; see `choose_runtime`."""
    if runtime != "auto":
        return Choice(runtime, "as set")
    stride = size_multiple(model.architecture)
    frame_hw = Letterbox.fit(USUAL_SOURCE_HW, image_size=image_size, stride=stride).network_hw
    return choose_runtime(model, device=device, precision=precision, frame_hw=frame_hw)


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
