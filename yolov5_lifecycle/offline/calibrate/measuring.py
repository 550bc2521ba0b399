"""What int8 is worth: its speed beside fp32, how far their detections agree, and the loss of mAP."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from yolov5_lifecycle.checkpoints.locate import WeightsFile
from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.detection.detector import Detector
from yolov5_lifecycle.detection.nms import Selection
from yolov5_lifecycle.detection.prepared_model import PreparedModel
from yolov5_lifecycle.evaluation.figures import mean_of_classes
from yolov5_lifecycle.evaluation.ground_truth import DataError, Problems
from yolov5_lifecycle.evaluation.matching import match
from yolov5_lifecycle.images.image import ColourImage
from yolov5_lifecycle.offline.detecting import DetectingError, ProgressListener
from yolov5_lifecycle.offline.evaluate.evaluating import LabelledData, evaluate_models
from yolov5_lifecycle.process.missing_package import absence_of
from yolov5_lifecycle.runtimes.speed import Taken, median, time_taken
from yolov5_lifecycle.settings.settings import Settings
from yolov5_lifecycle.tracking.assignment import iou_matrix

MIN_SPEEDUP = 1.15
MIN_AGREEMENT = 0.98
MAX_MAP_LOSS = 1.0
MIN_DETECTIONS = 50
_SMALLEST_IOU = 0.5
_WARM_UPS = 3


@dataclass(frozen=True)
class Measurement:
    """A runtime in one precision, measured on the calibration images and compared with fp32."""

    runtime: str
    precision: str
    taken: Taken
    """For an image, the median."""
    f1: float
    box_iou: float
    """See `agreement`."""


@dataclass(frozen=True)
class Worth:
    """What was measured of int8, once, and of fp32 and others beside it."""

    measured: Sequence[Measurement]
    detections: int
    """Detections of fp32 in the compared images; the fewer, the less is known."""
    map_loss: float | str
    """Points of mAP@50:95 that int8 loses against fp32, or why that is unknown."""

    def verdict(self) -> tuple[bool, str]:
        """Whether int8 pays, and the reason: it must be good, and faster than the fastest fp32."""
        (int8,) = (each for each in self.measured if each.precision == "int8")
        in_fp32 = (each for each in self.measured if each.precision == "fp32")
        fp32 = min(in_fp32, key=lambda each: each.taken.wall_ms)
        if problem := self._problem(int8.f1):
            return False, problem
        speedup = fp32.taken.wall_ms / int8.taken.wall_ms
        saving = fp32.taken.processor_ms / int8.taken.processor_ms
        told = (
            f"int8 is {speedup:.2f} x as fast as fp32 here ({int8.taken.wall_ms:.1f} ms, not "
            f"{fp32.taken.wall_ms:.1f}; {saving:.2f} x by processor time) and agrees with it to "
            f"{int8.f1:.3f} (F1)"
        )
        if min(speedup, saving) < MIN_SPEEDUP:
            return False, f"{told}; it pays from {MIN_SPEEDUP:g} x by both times"
        return True, told

    def _problem(self, f1: float) -> str:
        """Why int8 is not known to be good, or ""."""
        if self.detections < MIN_DETECTIONS:
            return (
                f"only {self.detections} detections were compared with fp32, which is less than "
                f"{MIN_DETECTIONS}: calibrate with other or more images"
            )
        if f1 < MIN_AGREEMENT:
            return f"int8 agrees with fp32 to {f1:.3f} (F1), which is less than {MIN_AGREEMENT:g}"
        if isinstance(self.map_loss, float) and self.map_loss > MAX_MAP_LOSS:
            return f"int8 loses {self.map_loss:.1f} points of mAP, which is more than {MAX_MAP_LOSS:g}"
        return ""


def measured(
    detectors: Mapping[tuple[str, str], Detector],
    images: Sequence[ColourImage],
    selection: Selection,
    tell: Callable[[str], None],
) -> tuple[list[Measurement], int]:
    """Measurements of `detectors`, by runtime and precision, and the number of detections of the first one.

    They run alternately, so that load affects all equally. The others are compared with the first.
    """
    taken: list[list[Taken]] = [[] for _ in detectors]
    found: list[list[Detections]] = [[] for _ in detectors]
    for detector in detectors.values():
        for _ in range(_WARM_UPS):
            detector.detect(images[0], selection)
    for number, image in enumerate(images):
        for detector, times, detections in zip(detectors.values(), taken, found, strict=True):
            times.append(time_taken(partial(_detect, detector, image, selection, detections)))
        tell(f"measuring: {number + 1} of {len(images)} images")
    measurements = [
        Measurement(*name, median(times), *agreement(found[0], others))
        for name, times, others in zip(detectors, taken, found, strict=True)
    ]
    return measurements, sum(map(len, found[0]))


def _detect(detector: Detector, image: ColourImage, selection: Selection, found: list[Detections]) -> None:
    found.append(detector.detect(image, selection))


def agreement(truth: Sequence[Detections], found: Sequence[Detections]) -> tuple[float, float]:
    """F1 of what was found in each image, and the mean IoU of the pairs, 0 without any.

    Pairs are of one class and an IoU of at least 0.5, the best found first. F1 is 1 if there is nothing.
    """
    ious: list[float] = []
    for true, other in zip(truth, found, strict=True):
        free = iou_matrix(other.boxes_xyxy, true.boxes_xyxy)
        free[other.class_ids[:, None] != true.class_ids] = 0
        for row in free:
            if row.max(initial=0) >= _SMALLEST_IOU:
                ious.append(float(row.max()))
                free[:, row.argmax()] = 0
    total = sum(map(len, truth)) + sum(map(len, found))
    return 2 * len(ious) / total if total else 1.0, float(np.mean(ious)) if ious else 0.0


def map_loss(
    data: LabelledData | None,
    weights: WeightsFile,
    settings: Settings,
    detectors: Mapping[str, Detector],
    *,
    listener: ProgressListener,
    problems: Problems,
) -> float | str:
    """Points of mAP@50:95 that the second of `detectors` loses against the first, or why that is unknown.

    Those of `weights`, by precision; evaluated on `data` with `settings`, as the command `evaluate` does.
    """
    if data is None:
        return "DATA has no labels"
    if absence := absence_of("pycocotools.cocoeval"):
        return absence

    def prepared(wanted: Settings, _: object) -> PreparedModel:
        return PreparedModel(wanted, detectors[wanted.precision], weights.path, weights.sha256)

    wanted = [settings.model_copy(update={"precision": precision}) for precision in detectors]
    try:
        classes, evaluations = evaluate_models(
            data, wanted, listener=listener, problems=problems, prepare=prepared
        )
    except (DataError, DetectingError) as error:
        return str(error)
    first, second = (
        float(mean_of_classes(match(each.images, classes.names).ap50_95)) for each in evaluations
    )
    return round(100 * (first - second), 2)
