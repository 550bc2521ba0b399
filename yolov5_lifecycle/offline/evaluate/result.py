"""The figures of one or two evaluations: as text for the terminal, as JSON, and as files."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from pydantic_core import to_jsonable_python

from yolov5_lifecycle.evaluation.figures import (
    MIN_IOU,
    RESAMPLES,
    confusion_matrix,
    differences,
    occurring,
    rows,
)
from yolov5_lifecycle.evaluation.ground_truth import Problems
from yolov5_lifecycle.evaluation.matching import (
    MAX_DETECTIONS,
    MIN_CONFIDENCE,
    EvaluatedClasses,
    found_annotations,
    match,
    truth_dataset,
)
from yolov5_lifecycle.evaluation.thresholds import Goal, chosen_thresholds, threshold_yaml
from yolov5_lifecycle.offline.evaluate.evaluating import Evaluation
from yolov5_lifecycle.printable import in_one_line
from yolov5_lifecycle.settings.value_text import value_text

FORMAT = 1
"""Version of report.json; a change that breaks its readers raises it."""
_MAX_CONFUSED = 10
"""With more classes the confusion matrix is not printed."""
_COMPARED = ("f1", "ap50", "ap50_95")
"""The metrics of a comparison that are printed; the report has all."""
_HEADS = {"precision": "precision", "recall": "recall", "f1": "F1", "ap50": "mAP@50", "ap50_95": "mAP@50:95"}
_MAX_NAME = 40


class EvaluationResult:
    """The figures of `evaluations` of one data set, of `classes`; a second one is compared with the first.

    `report` is what report.json has; docs/evaluation.md explains it.
    """

    def __init__(
        self,
        source: Path,
        kind: str,
        classes: EvaluatedClasses,
        evaluations: Sequence[Evaluation],
        problems: Problems,
        goal: Goal | None,
    ) -> None:
        self._names = classes.names
        self._evaluations = evaluations
        self._problems = problems
        self._goal = goal
        self._matches = [match(evaluation.images, self._names) for evaluation in evaluations]
        self._chosen = [] if goal is None else chosen_thresholds(self._matches[0], goal)
        first = evaluations[0]
        all_classes, *of_class = rows(self._matches[0], first.thresholds)
        self.report: dict[str, Any] = {
            "format": FORMAT,
            "data": {
                "path": str(source),
                "kind": kind,
                "images": len(first.images),
                "objects": all_classes["objects"],
                "classes_left_out": classes.left_out,
                "problems": {"counts": problems.counts, "first": problems.first},
            },
            "model": _model(first),
            "evaluation": {
                "iou": MIN_IOU,
                "min_confidence": MIN_CONFIDENCE,
                "max_detections_per_class": MAX_DETECTIONS,
            },
            "all": all_classes,
            "classes": of_class,
            "confusion_matrix": self._confusion(),
        }
        if len(evaluations) > 1:
            self.report["comparison"] = self._comparison()
        if goal is not None:
            together, *each = (
                {"name": one.name, "threshold": one.value, **one.figures} for one in self._chosen
            )
            self.report["thresholds"] = {"goal": str(goal), "all": together, "classes": each}

    def _confusion(self) -> dict[str, Any]:
        first = self._evaluations[0]
        matrix = confusion_matrix(first.images, self._matches[0], first.thresholds)
        counts, names = occurring(matrix, self._names)
        objects, detected_as = [*names, "no object"], [*names, "nothing"]
        return {"objects": objects, "detected_as": detected_as, "counts": counts.tolist()}

    def _comparison(self) -> dict[str, Any]:
        first, second = self._evaluations
        intervals = differences(self._matches, [first.thresholds, second.thresholds])
        one, other = first.settings.model_dump(mode="json"), second.settings.model_dump(mode="json")
        return {
            "model": _model(second),
            "resamples": RESAMPLES,
            "changed": {name: value for name, value in other.items() if value != one[name]},
            "rows": [
                {**row, "intervals": of_class}
                for row, of_class in zip(rows(self._matches[1], second.thresholds), intervals, strict=True)
            ],
        }

    def text(self, node: str) -> str:
        """What is printed; `node`: the full name of the node that thresholds are for."""
        parts = [self._head(), _table([self.report["all"], *self.report["classes"]])]
        if len(self.report["confusion_matrix"]["counts"]) <= _MAX_CONFUSED + 1:
            parts.append(_confusion_table(**self.report["confusion_matrix"]))
        if comparison := self.report.get("comparison"):
            parts.append(_comparison_table(comparison["rows"]) + self._differences())
        if self._goal is not None:
            parts.append(threshold_yaml(self._chosen, self._goal, node))
        return "\n".join(parts)

    def write(self, folder: Path) -> None:
        """Write the report, and the detections and ground truth behind it to the new `folder`.

        Raises OSError.
        """
        first = self._evaluations[0]
        folder.mkdir()
        _write_json(folder / "report.json", self.report, indent=2)
        _write_json(folder / "ground_truth.json", truth_dataset(first.images, self._names))
        names = ("detections.json", "detections_other.json")
        for name, evaluation in zip(names, self._evaluations, strict=False):
            fields = ("image_id", "category_id", "bbox", "score")
            found = found_annotations(evaluation.images)
            _write_json(folder / name, [{field: one[field] for field in fields} for one in found])

    def _head(self) -> str:
        data, model = self.report["data"], self.report["model"]
        first = self._evaluations[0]
        lines = [
            f"model   {in_one_line(model['weights'])}, {model['runtime']} on {model['device']}, "
            f"{model['precision']}, image size {first.settings.image_size}",
            f"data    {in_one_line(data['path'])}: {data['images']} images, {data['objects']} objects",
            f"speed   {_median_ms(model)} per image, the median of {len(first.times_ms)}",
            f"counted at confidence_threshold {_thresholds(first)} and IoU {MIN_IOU}",
        ]
        if left_out := data["classes_left_out"]:
            shown = ", ".join(in_one_line(name, 40) for name in left_out[:_MAX_CONFUSED])
            lines.append(f"left out, not in the model or not selected by its settings: {shown}")
        if self._problems.counts:
            lines.append(f"not evaluated: {self._problems.summary}")
        return "".join(f"{line}\n" for line in lines)

    def _differences(self) -> str:
        """The settings in which the second model differs, and its speed."""
        comparison = self.report["comparison"]
        # As they are written after `--compare NAME=`.
        changed = {
            name: value if isinstance(value, str) else value_text(value)
            for name, value in comparison["changed"].items()
        }
        lines = [f"OTHER has {name}={in_one_line(value)}\n" for name, value in changed.items()]
        speeds = f"{_median_ms(self.report['model'])} per image, OTHER {_median_ms(comparison['model'])}"
        return "".join((*lines, f"speed   {speeds}\n"))


def _write_json(path: Path, content: object, *, indent: int | None = None) -> None:
    """Write `content` with `null` for NaN, and bytes of file names that are not UTF-8 escaped."""
    plain = to_jsonable_python(content, inf_nan_mode="null")
    path.write_text(f"{json.dumps(plain, indent=indent, allow_nan=False)}\n", encoding="utf-8")


def _model(evaluation: Evaluation) -> dict[str, Any]:
    """The model with its settings and times."""
    times_ms = evaluation.times_ms
    return {
        **evaluation.model.facts,
        "settings": evaluation.settings.model_dump(mode="json"),
        "speed_ms": {
            "median": float(np.median(times_ms)) if len(times_ms) else None,
            "p95": float(np.quantile(times_ms, 0.95)) if len(times_ms) else None,
            "images": len(times_ms),
        },
    }


def _thresholds(evaluation: Evaluation) -> str:
    """The threshold of the model, and how many classes have their own."""
    usual = evaluation.settings.confidence_threshold
    others = np.count_nonzero(evaluation.thresholds != usual)
    return f"{usual:g} (own thresholds for {others} classes)" if others else f"{usual:g}"


def _median_ms(model: Mapping[str, Any]) -> str:
    median = model["speed_ms"]["median"]
    return "unknown" if median is None else f"{median:.1f} ms"


def _table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Figures of all classes together and of each that has objects or detections, in columns."""
    shown = [row for row in rows if row["objects"] or row["right"] or row["wrong"]]
    cells = [["class", "images", "objects", *_HEADS.values()]] + [
        [
            in_one_line(row["name"], _MAX_NAME),
            str(row["images"]),
            str(row["objects"]),
            *(_shown(row[metric]) for metric in _HEADS),
        ]
        for row in shown
    ]
    absent = len(rows) - len(shown)
    more = f"{absent} more classes have neither objects nor detections\n" if absent else ""
    return _aligned(cells) + more


def _comparison_table(rows: Sequence[Mapping[str, Any]]) -> str:
    """For each class and metric of _COMPARED: both models, the interval of the difference, the verdict."""
    cells = [["class", "figure", "WEIGHTS", "OTHER", "difference, 95 %", "OTHER is"]]
    for row in rows:
        for metric in _COMPARED:
            found = row["intervals"][metric]
            if found.verdict:
                both = f"{found.difference_low:+.3f} to {found.difference_high:+.3f}"
                figures = [_shown(found.first), _shown(found.second), both, found.verdict]
                cells.append([in_one_line(row["name"], _MAX_NAME), _HEADS[metric], *figures])
    return _aligned(cells)


def _confusion_table(objects: Sequence[str], detected_as: Sequence[str], counts: Sequence[list[int]]) -> str:
    """Numbers of objects of each class, a row each, by what they were detected as."""
    cells = [["object \\ detected as", *(in_one_line(name, _MAX_NAME) for name in detected_as)]]
    for name, row in zip(objects, counts, strict=True):
        cells.append([in_one_line(name, _MAX_NAME), *map(str, row)])
    cells[-1][-1] = ""
    return _aligned(cells)


def _shown(value: float) -> str:
    return f"{value:.3f}" if math.isfinite(value) else "-"


def _aligned(cells: Sequence[Sequence[str]]) -> str:
    """Rows with columns of one width: texts to the left, numbers to the right."""
    columns = []
    for column in zip(*cells, strict=True):
        is_text = any(cell[:1].isalpha() for cell in column[1:])
        columns.append([f"{cell:{'<' if is_text else '>'}{max(map(len, column))}}" for cell in column])
    return "".join(f"{'  '.join(row).rstrip()}\n" for row in zip(*columns, strict=True))
