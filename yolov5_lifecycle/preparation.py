"""From settings to a model that is ready to detect."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from yolov5_lifecycle.confinement import confined
from yolov5_lifecycle.detector import Detector, load_detector
from yolov5_lifecycle.memory import give_back_memory
from yolov5_lifecycle.package_path import resolve_package
from yolov5_lifecycle.setting import Change
from yolov5_lifecycle.settings import Settings
from yolov5_lifecycle.weights import find_weights, load_weights


@dataclass(frozen=True)
class PreparedModel:
    """A warm detector, the settings it was made for and the file it came from."""

    settings: Settings
    detector: Detector
    weights_path: Path
    weights_sha256: str

    @property
    def facts(self) -> dict[str, str]:
        """What was resolved, for the log and diagnostics."""
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
        """Whether `settings` ask for this very model."""
        return not self.settings.differing(settings, Change.RELOAD)

    @property
    def summary(self) -> str:
        """`facts` in one line."""
        return ", ".join(f"{name} {value}" for name, value in self.facts.items())

    def close(self, *, is_at_rest: bool = True) -> None:
        """Free the model and give its memory back to the system.

        Unless it `is_at_rest`, memory is not given back: on a GPU that would wait for the frame that hangs.
        No cycle holds a network, so no garbage collection is needed; one would stop every thread for 0.15 s.
        """
        self.detector.close()
        if is_at_rest:
            give_back_memory()


Prepare = Callable[[Settings, tuple[int, int]], PreparedModel]
"""See `prepare_model`."""


def prepare_model(settings: Settings, source_hw: tuple[int, int]) -> PreparedModel:
    """Find, read and build the model that `settings` name, and warm it up with pictures of `source_hw`.

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
    except BaseException:  # whose traceback keeps the detector alive
        detector.close()
        raise
    return PreparedModel(settings, detector, weights.path, weights.sha256)


def check_place(settings: Settings) -> None:
    """Raise ValueError if the weights would come from outside `weights_dirs`; looks for no file."""
    if folders := _folders(settings):
        confined(Path(resolve_package(settings.weights or settings.weights_dir)), folders)


def _folders(settings: Settings) -> list[Path]:
    return [Path(resolve_package(folder)) for folder in settings.weights_dirs]
