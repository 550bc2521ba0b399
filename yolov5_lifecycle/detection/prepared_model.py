"""Settings -> loaded and warmed-up model."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from yolov5_lifecycle.checkpoints.allowed_folders import confined
from yolov5_lifecycle.checkpoints.locate import find_weights, load_weights
from yolov5_lifecycle.detection.detector import Detector, load_detector
from yolov5_lifecycle.package_path import resolve_package
from yolov5_lifecycle.process.memory import release_unused_memory
from yolov5_lifecycle.settings.schema import Change
from yolov5_lifecycle.settings.settings import Settings


@dataclass(frozen=True)
class PreparedModel:
    """A warmed-up detector with its settings and weights file."""

    settings: Settings
    detector: Detector
    weights_path: Path
    weights_sha256: str

    @property
    def facts(self) -> dict[str, str]:
        """Resolved weights, runtime, device and precision, for the log and diagnostics."""
        runtime = self.detector.runtime
        return {
            "weights": str(self.weights_path),
            "sha256": self.weights_sha256,
            "classes": str(len(self.detector.class_names)),
            "runtime": runtime.name,
            "runtime choice": self.detector.choice,
            "device": runtime.device,
            "precision": runtime.precision,
        }

    def serves(self, settings: Settings) -> bool:
        """Whether this model serves `settings` without a reload."""
        return not self.settings.differing(settings, Change.RELOAD)

    @property
    def summary(self) -> str:
        """`facts` on one line."""
        return ", ".join(f"{name} {value}" for name, value in self.facts.items())

    def close(self, *, is_at_rest: bool = True) -> None:
        """Free the model and return its memory to the system.

        Unless it `is_at_rest`, memory is not returned: on a GPU that would wait for the hanging frame.
        No reference cycle holds a network, so no gc run is needed; one would stop all threads for 0.15 s.
        """
        self.detector.close()
        if is_at_rest:
            release_unused_memory()


Prepare = Callable[[Settings, tuple[int, int]], PreparedModel]
"""See `prepare_model`."""


def prepare_model(settings: Settings, source_hw: tuple[int, int]) -> PreparedModel:
    """Find, load and build the model that `settings` select, and warm it up at image size `source_hw`.

    Raises ValueError (WeightsError, DeviceError) or OSError with a message for the user.
    """
    path = find_weights(
        weights=resolve_package(settings.weights),
        weights_dir=Path(resolve_package(settings.weights_dir)),
        model_size=settings.model_size,
        weights_dirs=_folders(settings),
    )
    weights = load_weights(path, sha256=settings.weights_sha256)
    detector = load_detector(
        weights.model,
        runtime=settings.runtime,
        device=settings.device,
        precision=settings.precision,
        image_size=settings.image_size,
    )
    try:
        detector.warm_up(source_hw)
    except BaseException:  # its traceback keeps the detector alive
        detector.close()
        raise
    return PreparedModel(settings, detector, weights.path, weights.sha256)


def check_place(settings: Settings) -> None:
    """Raise ValueError if the weights path is outside `weights_dirs`; does not search for the file."""
    if folders := _folders(settings):
        confined(Path(resolve_package(settings.weights or settings.weights_dir)), folders)


def _folders(settings: Settings) -> list[Path]:
    return [Path(resolve_package(folder)) for folder in settings.weights_dirs]
