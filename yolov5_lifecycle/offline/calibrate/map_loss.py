"""How much average precision int8 loses on labelled images."""

from __future__ import annotations

from yolov5_lifecycle.checkpoints.locate import WeightsFile
from yolov5_lifecycle.detection.detector import Detector
from yolov5_lifecycle.detection.prepared_model import PreparedModel
from yolov5_lifecycle.evaluation.evaluated import EvaluatedClasses
from yolov5_lifecycle.evaluation.figures import mean_of_classes
from yolov5_lifecycle.evaluation.ground_truth import DataError, Problems
from yolov5_lifecycle.evaluation.matching import match
from yolov5_lifecycle.offline.detecting import DetectingError, Watch
from yolov5_lifecycle.offline.evaluate.evaluating import LabelledData, evaluate_models
from yolov5_lifecycle.process.missing_package import absence_of
from yolov5_lifecycle.settings.settings import Settings

_DIGITS = 2


class MapLoss:
    """Evaluates detectors of `weights` on `data` with `settings`, as the command `evaluate` does.

    `unknown`: why the loss cannot be measured, as far as is known; "" if nothing prevents it.
    """

    def __init__(
        self,
        data: LabelledData | None,
        weights: WeightsFile,
        settings: Settings,
        *,
        watch: Watch,
        problems: Problems,
    ) -> None:
        self._data = data
        self._weights = weights
        self._settings = settings
        self._watch = watch
        self._problems = problems
        self.unknown = self._obstacle()

    def __call__(self, fp32: Detector, int8: Detector) -> float | None:
        """Points of mAP@50:95, in percent, that `int8` loses against `fp32`; None if that is unknown."""
        if self._data is None or self.unknown:
            return None
        try:
            return self._points(self._data, {"fp32": fp32, "int8": int8})
        except (DataError, DetectingError) as error:
            self.unknown = str(error)
            return None

    def _points(self, data: LabelledData, detectors: dict[str, Detector]) -> float:
        def prepared(wanted: Settings, _: object) -> PreparedModel:
            return PreparedModel(
                wanted, detectors[wanted.precision], self._weights.path, self._weights.sha256
            )

        wanted = [self._settings.model_copy(update={"precision": precision}) for precision in detectors]
        classes, evaluations = evaluate_models(
            data, wanted, watch=self._watch, problems=self._problems, prepare=prepared
        )
        fp32, int8 = (float(mean_of_classes(match(one.images, classes.names).ap50_95)) for one in evaluations)
        return round(100 * (fp32 - int8), _DIGITS)

    def _obstacle(self) -> str:
        """Why the loss cannot be measured, as far as is known before the evaluation; else ""."""
        if self._data is None:
            return "DATA has no labels"
        if absence := absence_of("pycocotools.cocoeval"):
            return absence
        try:
            EvaluatedClasses.shared(self._data.class_names, [(self._weights.model.class_names, None)])
        except DataError as error:
            return str(error)
        return ""
