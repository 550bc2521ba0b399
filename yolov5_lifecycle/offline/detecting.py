"""Sequential detection in all images of a source, with statistics."""

from __future__ import annotations

import itertools
import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.detection.class_filter import model_problems, selection_of
from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.detection.detector import USUAL_SOURCE_HW
from yolov5_lifecycle.detection.draw import annotate
from yolov5_lifecycle.detection.prepared_model import FixedSizeError, Prepare, PreparedModel
from yolov5_lifecycle.images.image import ColourImage, ImageError
from yolov5_lifecycle.runtimes.runtime import DeviceLostError, InferenceError
from yolov5_lifecycle.settings.schema import SettingsError
from yolov5_lifecycle.settings.settings import Settings
from yolov5_lifecycle.streaming.frame_statistics import Outcome
from yolov5_lifecycle.tracking.byte_tracker import StampCounts, TrackedDetection


class StoredImage(Protocol):
    """An image of a recording, a folder or a video, loaded on demand."""

    @property
    def label(self) -> str:
        """Its name in messages: a time stamp, a file, a frame number."""

    @property
    def stamp_s(self) -> float | None:
        """When it was taken, in seconds since any epoch; None if unknown. Raises ImageError."""

    @property
    def identity(self) -> Mapping[str, str | int]:
        """What tells it from the others: `file`, `frame`, or `stamp_ns` and `frame`. Raises ImageError."""

    @property
    def stem(self) -> str:
        """Name of files about it, without a suffix; raises ImageError."""

    def load(self) -> ColourImage:
        """Load the pixels; raises ImageError."""


Stored = TypeVar("Stored", bound=StoredImage)


class DetectingError(RuntimeError):
    """Detection was aborted or produced no result."""


@dataclass
class RunStatistics:
    """Statistics of a run over a source that claims to have `expected` images, 0 if unknown."""

    expected: int
    stamps: StampCounts = field(default_factory=StampCounts)
    missing: int = 0
    """Images that a recording claims and does not have."""
    outcomes: Counter[Outcome] = field(default_factory=Counter)
    objects: Counter[str] = field(default_factory=Counter)
    """Detections by class."""
    begun_s: float = field(default_factory=time.monotonic)

    @property
    def counts(self) -> dict[str, int]:
        """What is counted in a summary."""
        return {
            "images": self.outcomes.total(),
            "detected": self.outcomes[Outcome.DETECTED],
            "rejected": self.outcomes[Outcome.REJECTED],
            "failed": self.outcomes[Outcome.FAILED],
            "missing": self.missing,
            "late": self.stamps.late,
            "jumps": self.stamps.jumps,
        }

    @property
    def rate_hz(self) -> float:
        """Images per second so far."""
        return self.outcomes.total() / max(time.monotonic() - self.begun_s, 1e-9)


class RunObserver(Protocol):
    """Observer of a run."""

    def lost(self, label: str, outcome: Outcome, error: Exception) -> None:
        """Called if the image named `label` could not be processed."""

    def progress(self, statistics: RunStatistics) -> None:
        """Called after every image."""


def prepared_for(settings: Settings, prepare: Prepare) -> PreparedModel:
    """The model that `prepare` loads; one of a fixed image size with that, unless `settings` set another.

    Raises what `prepare` raises, and SettingsError for classes unknown to the model.
    """
    try:
        prepared = prepare(settings, (USUAL_SOURCE_HW,))
    except FixedSizeError as error:
        if "image_size" in settings.model_fields_set:
            raise
        prepared = prepare(settings.model_copy(update={"image_size": error.image_size}), (USUAL_SOURCE_HW,))
    if problems := model_problems(settings, prepared.detector.class_names):
        raise SettingsError(problems)
    return prepared


class OfflineDetector:
    """Detector with the model of `prepared_for`, and `settings` that apply to every image.

    With the setting `tracker`, images that have a time are tracked, as the images of one camera.
    `with_masks`: whether the detections of a segmentation model have masks; computing them takes time.
    """

    def __init__(
        self, settings: Settings, prepared: PreparedModel, observer: RunObserver, *, with_masks: bool
    ) -> None:
        self.settings = settings
        self._observer = observer
        self._detector = prepared.detector
        self.class_names = self._detector.class_names
        self._selection = replace(selection_of(settings, self.class_names), with_masks=with_masks)
        self._stamps = StampCounts()
        self._tracking = TrackedDetection.started(settings, itertools.count(1), self._stamps)
        self._failures = 0
        self._first_loss = ""

    @property
    def segments(self) -> bool:
        """Whether the model computes masks."""
        return self._detector.segments

    def drawn(
        self, image: ColourImage, detections: Detections, label_image: NDArray[np.uint16] | None = None
    ) -> ColourImage:
        """`image` with its `detections`, whose `label_image` may be known, and the regions that count."""
        pixels = annotate(
            image,
            detections,
            self.class_names,
            label_image=label_image,
            box_filter=self._selection.box_filter,
        )
        return ColourImage(pixels, image.channel_order)

    def run(
        self,
        images: Iterable[Stored],
        *,
        expected: int,
        write: Callable[[Stored, ColourImage, Detections], None],
    ) -> RunStatistics:
        """Detect in every image and `write` the result; images that fail are reported and counted.

        Raises DetectingError after too many consecutive inference failures, if the device is lost, or if no
        image could be used.
        """
        statistics = RunStatistics(expected, self._stamps)
        for stored in images:
            statistics.outcomes[self._detect(stored, write, statistics.objects)] += 1
            self._observer.progress(statistics)
        if not (count := statistics.outcomes.total()):
            raise DetectingError("there are no images to use")
        if not statistics.outcomes[Outcome.DETECTED]:
            raise DetectingError(f"none of {count} images could be used, the first: {self._first_loss}")
        return statistics

    def _detect(
        self,
        stored: Stored,
        write: Callable[[Stored, ColourImage, Detections], None],
        objects: Counter[str],
    ) -> Outcome:
        try:
            image = stored.load()
            detections = self._detections(stored, image)
        except ImageError as error:
            return self._lost(stored, Outcome.REJECTED, error)
        except InferenceError as error:
            outcome = self._lost(stored, Outcome.FAILED, error)
            self._count_failure(error)
            return outcome
        self._failures = 0
        write(stored, image, detections)
        objects.update(self.class_names[class_id] for class_id in detections.class_ids.tolist())
        return Outcome.DETECTED

    def _lost(self, stored: Stored, outcome: Outcome, error: Exception) -> Outcome:
        self._first_loss = self._first_loss or str(error)
        self._observer.lost(stored.label, outcome, error)
        return outcome

    def _detections(self, stored: StoredImage, image: ColourImage) -> Detections:
        stamp_s = None if self._tracking is None else stored.stamp_s
        if self._tracking is None or stamp_s is None:
            return self._detector.detect(image, self._selection)
        return self._tracking.detect(self._detector, image, self._selection, stamp_s)

    def _count_failure(self, error: InferenceError) -> None:
        self._failures += 1
        too_many = self._failures >= self.settings.max_consecutive_failures
        if too_many or isinstance(error, DeviceLostError):
            raise DetectingError(
                f"stopped after {self._failures} consecutive failed images: {error}"
            ) from error


LoadDetector = Callable[[], OfflineDetector]
"""Loads the model; called once all other inputs are validated."""
