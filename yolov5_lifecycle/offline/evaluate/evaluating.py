"""One or two models on the same labelled images: what they find, and how long it takes them."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.detection.class_filter import class_ids, selection_of
from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.detection.prepared_model import Prepare, PreparedModel
from yolov5_lifecycle.evaluation.ground_truth import DataError, LabelledFolder, Problems, check_count
from yolov5_lifecycle.evaluation.matching import MIN_CONFIDENCE, EvaluatedClasses, EvaluatedImage
from yolov5_lifecycle.images.image import ColourImage, ImageError
from yolov5_lifecycle.offline.detecting import OfflineDetector, RunObserver, prepared_for
from yolov5_lifecycle.offline.image_files import ImageFile
from yolov5_lifecycle.runtimes.runtime import InferenceError
from yolov5_lifecycle.settings.settings import SETTINGS_BY_NAME, Settings

TIMED_IMAGES = 30

NOT_APPLIED = ("regions", "ignore_regions", "min_box_size", "max_box_size", "tracker")
"""Settings that stay at their defaults: regions and sizes would remove detections, but not labels."""
MAX_CLASSES_IN_IMAGES = 32_000_000
"""Classes x images; pycocotools takes 0.2 kB and some microseconds for each pair."""
MAX_FOUND = 5_000_000
"""Detections of a model that are kept; each takes about 1.5 kB while pycocotools compares them."""
_FEWER = "lower max_detections, or evaluate a part of the data"
_WHILE_EVALUATING = {
    "confidence_threshold": MIN_CONFIDENCE,
    **{name: SETTINGS_BY_NAME[name].default for name in ("class_thresholds", *NOT_APPLIED)},
}
"""Average precision needs detections below the thresholds; those above are the same with and without them."""


@dataclass(frozen=True, eq=False)
class Evaluation:
    """What a model found in images, and how long detection takes, from the letterbox to NMS."""

    model: PreparedModel
    settings: Settings
    thresholds: NDArray[np.float64]
    """The confidence threshold that is set for each evaluated class."""
    images: tuple[EvaluatedImage, ...]
    times_ms: NDArray[np.float64]
    """(t,) for a sample of the images, the same for every model, with the thresholds of `settings`."""


class _Model:
    """A loaded model and its number among those that are compared."""

    def __init__(self, number: int, settings: Settings, observer: RunObserver, prepare: Prepare) -> None:
        self.number = number
        self.prepared = prepared_for(settings, prepare)
        evaluated = settings.model_copy(update=_WHILE_EVALUATING)
        self.offline = OfflineDetector(evaluated, self.prepared, observer, with_masks=False)
        self.settings = settings.model_copy(update={"image_size": self.prepared.settings.image_size})
        self._selection = selection_of(self.settings, self.offline.class_names)

    @property
    def wanted(self) -> frozenset[int] | None:
        """The ids of the classes that its settings select, None for all."""
        return class_ids(self.settings.classes, self.offline.class_names)

    def thresholds(self, classes: EvaluatedClasses) -> NDArray[np.float64]:
        """The confidence threshold of each of `classes`."""
        thresholds = np.full(len(classes.names), self._selection.confidence_threshold)
        for class_id, threshold in self._selection.class_thresholds:
            if (index := classes.of_models[self.number][class_id]) >= 0:
                thresholds[index] = threshold
        return thresholds

    def time_ms(self, image: ColourImage) -> float:
        """How long it takes to detect in `image` with the thresholds that are set; raises InferenceError."""
        begun_s = time.perf_counter()
        self.prepared.detector.detect(image, self._selection)
        return (time.perf_counter() - begun_s) * 1e3


def evaluate_models(
    data: LabelledFolder,
    wanted: Sequence[Settings],
    *,
    observer: RunObserver,
    problems: Problems,
    prepare: Prepare,
) -> tuple[EvaluatedClasses, list[Evaluation]]:
    """Load a model for each of the `wanted` settings and let it detect in all images of `data`.

    An image that one model cannot use is left out for all. Raises DataError and DetectingError if nothing is
    left, and what `prepared_for` raises.
    """
    models = [_Model(number, settings, observer, prepare) for number, settings in enumerate(wanted)]
    classes = EvaluatedClasses.shared(
        data.class_names, [(model.offline.class_names, model.wanted) for model in models]
    )
    pairs = len(classes.names) * len(data.images)
    check_count("the data set", "classes x images", pairs, MAX_CLASSES_IN_IMAGES)
    timed: dict[int, ImageFile] = {}
    found = [_found(data, model, classes, problems, timed) for model in models]
    common = sorted(set(found[0]).intersection(*found[1:]))
    if all(found[0][number].truth.is_crowd.all() for number in common):
        raise DataError(
            f"None of {len(common)} images has an object of the classes that data and model share: "
            f"{', '.join(classes.names[:10])}. {problems.summary}"
        )
    times = _times_ms(models, timed.values())
    return classes, [
        Evaluation(
            model.prepared,
            model.settings,
            model.thresholds(classes),
            tuple(images[number] for number in common),
            of_model,
        )
        for model, images, of_model in zip(models, found, times, strict=True)
    ]


def _found(
    data: LabelledFolder,
    model: _Model,
    classes: EvaluatedClasses,
    problems: Problems,
    timed: dict[int, ImageFile],
) -> dict[int, EvaluatedImage]:
    """The evaluated images by number; a sample of them is kept in `timed`."""
    images: dict[int, EvaluatedImage] = {}
    counts: Counter[str] = Counter()
    sample = set(np.linspace(0, len(data.images) - 1, TIMED_IMAGES).round().astype(int).tolist())

    def keep(stored: ImageFile, image: ColourImage, detections: Detections) -> None:
        try:
            truth = classes.truth(data.images[stored.number].in_pixels(image.size_hw))
        except DataError as error:
            if model.number == 0:
                problems.add("broken labels", stored.label, error)
            return
        found = classes.found(detections, model.number)
        counts["found"] += len(found)
        check_count("the model", "detections", counts["found"], MAX_FOUND, remedy=_FEWER)
        images[stored.number] = EvaluatedImage(stored.label, image.size_hw, truth, found)
        if stored.number in sample:
            timed[stored.number] = stored

    files = [ImageFile(labelled.path, number) for number, labelled in enumerate(data.images)]
    model.offline.run(files, expected=len(files), write=keep)
    return images


def _times_ms(models: Sequence[_Model], images: Iterable[ImageFile]) -> list[NDArray[np.float64]]:
    """The times of each model in the same images; images that cannot be read again have none.

    Of each image the shorter of two times, run in the order ABBA, so that no model gains from its place.
    """
    times: list[list[float]] = []
    for stored in images:
        with suppress(ImageError, InferenceError):
            image = stored.load()
            there = [model.time_ms(image) for model in models]
            back = [model.time_ms(image) for model in reversed(models)]
            times.append(list(map(min, there, reversed(back))))
    return list(np.array(times, np.float64).reshape(-1, len(models)).T)
