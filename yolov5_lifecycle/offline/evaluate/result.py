"""The figures of one or two evaluations: as text for the terminal, as JSON, and as files."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.evaluation.bootstrap import RESAMPLES, SEED, Interval, differences, interval
from yolov5_lifecycle.evaluation.curves import draw_confusion_matrix, draw_f1_curve, draw_pr_curve
from yolov5_lifecycle.evaluation.figures import MIN_IOU, Row, confusion_matrix, occurring, rows
from yolov5_lifecycle.evaluation.ground_truth import Problems
from yolov5_lifecycle.evaluation.matching import (
    MAX_DETECTIONS,
    MIN_CONFIDENCE,
    EvaluatedClasses,
    Matches,
    found_annotations,
    match,
    truth_dataset,
)
from yolov5_lifecycle.evaluation.thresholds import Goal, Threshold, chosen_thresholds, threshold_yaml
from yolov5_lifecycle.offline.evaluate.evaluating import Evaluation
from yolov5_lifecycle.printable import in_one_line
from yolov5_lifecycle.settings.value_text import value_text

FORMAT = 1
"""Version of report.json; a change that breaks its readers raises it."""
_MAX_CONFUSED = 10
"""With more classes the confusion matrix is not printed."""
_SPEED_MARGIN = 0.03
"""Share of the time per image; smaller differences are not reported as differences."""
_COMPARED = ("f1", "ap50", "ap50_95")
"""The metrics of a comparison that are printed; the report has all."""
_HEADS = {"precision": "precision", "recall": "recall", "f1": "F1", "ap50": "mAP@50", "ap50_95": "mAP@50:95"}
_MAX_NAME = 40


@dataclass(frozen=True, eq=False)
class EvaluationResult:
    """The figures of `evaluations` of one data set; a second one is compared with the first."""

    source: Path
    kind: str
    classes: EvaluatedClasses
    evaluations: Sequence[Evaluation]
    problems: Problems
    goal: Goal | None

    @cached_property
    def _matches(self) -> list[Matches]:
        return [match(evaluation.images, self.classes.names) for evaluation in self.evaluations]

    @cached_property
    def _rows(self) -> list[list[Row]]:
        """For each evaluation the figures of all classes, then of each."""
        thresholds = [evaluation.thresholds for evaluation in self.evaluations]
        return list(map(rows, self._matches, thresholds))

    @cached_property
    def _confusion(self) -> tuple[NDArray[np.int64], tuple[str, ...]]:
        """See `occurring`."""
        first = self.evaluations[0]
        counts = confusion_matrix(first.images, self._matches[0], first.thresholds)
        return occurring(counts, self.classes.names)

    @cached_property
    def _differences(self) -> list[dict[str, Interval]]:
        """For all classes, then for each, the intervals by metric; empty without a comparison."""
        if len(self.evaluations) < 2:
            return []
        return differences(self._matches, [evaluation.thresholds for evaluation in self.evaluations])

    @cached_property
    def _speed_verdict(self) -> str | None:
        """Whether the second model is `better` or `worse`; None without a comparison or times."""
        if len(self.evaluations) < 2 or not len(self.evaluations[0].times_ms):
            return None
        # Shorter is better; a small difference is due to the moment rather than to the models.
        first, second = (evaluation.times_ms for evaluation in self.evaluations)
        drawn = np.random.default_rng(SEED).integers(0, len(first), (RESAMPLES, len(first)))
        samples = (_log_speed(first[drawn]), _log_speed(second[drawn]))
        figures = (float(_log_speed(first)), float(_log_speed(second)))
        return interval(samples, figures, len(first), margin=_SPEED_MARGIN).verdict

    @cached_property
    def _chosen(self) -> list[Threshold]:
        return [] if self.goal is None else chosen_thresholds(self._matches[0], self.goal)

    def text(self, node: str) -> str:
        """What is printed; `node`: the full name of the node that thresholds are for."""
        parts = [self._head(), table(self._rows[0])]
        if len(self._confusion[1]) <= _MAX_CONFUSED:
            parts.append(confusion_table(*self._confusion))
        if self._differences:
            names = [row.name for row in self._rows[0]]
            parts.append(comparison_table(names, self._differences, _COMPARED) + self._speed_line())
        if self.goal is not None:
            parts.append(threshold_yaml(self._chosen, self.goal, node))
        return "\n".join(parts)

    def write(self, folder: Path) -> None:
        """Write report, curves, and the detections and ground truth behind them to the new `folder`.

        Raises OSError.
        """
        first = self.evaluations[0]
        folder.mkdir()
        _write_json(folder / "report.json", _without_nan(self._report()), indent=2)
        _write_json(folder / "ground_truth.json", truth_dataset(first.images, self.classes.names))
        names = ("detections.json", "detections_other.json")
        for name, evaluation in zip(names, self.evaluations, strict=False):
            fields = ("image_id", "category_id", "bbox", "score")
            found = found_annotations(evaluation.images)
            _write_json(folder / name, [{field: one[field] for field in fields} for one in found])
        draw_pr_curve(folder / "pr_curve.png", self._matches[0])
        draw_f1_curve(folder / "f1_curve.png", self._matches[0], first.settings.confidence_threshold)
        draw_confusion_matrix(folder / "confusion_matrix.png", *self._confusion)

    def _report(self) -> dict[str, Any]:
        """What report.json has; docs/evaluation.md explains it."""
        first = self.evaluations[0]
        counts, names = self._confusion
        all_classes, *classes = map(_row_as_json, self._rows[0])
        report: dict[str, Any] = {
            "format": FORMAT,
            "data": {
                "path": str(self.source),
                "kind": self.kind,
                "images": len(first.images),
                "objects": all_classes["objects"],
                "classes_left_out": self.classes.left_out,
                "problems": {"counts": self.problems.counts, "first": self.problems.first},
            },
            "model": _model(first),
            "evaluation": {
                "iou": MIN_IOU,
                "min_confidence": MIN_CONFIDENCE,
                "max_detections_per_class": MAX_DETECTIONS,
            },
            "all": all_classes,
            "classes": classes,
            "confusion_matrix": {
                "objects": [*names, "no object"],
                "detected_as": [*names, "nothing"],
                "counts": counts.tolist(),
            },
        }
        if self._differences:
            report["comparison"] = self._comparison()
        if self.goal is not None:
            chosen = [{"name": one.name, "threshold": one.value, **one.figures} for one in self._chosen]
            report["thresholds"] = {"goal": str(self.goal), "all": chosen[0], "classes": chosen[1:]}
        return report

    def _comparison(self) -> dict[str, Any]:
        first, second = self.evaluations
        pairs = zip(self._rows[1], self._differences, strict=True)
        return {
            "model": _model(second),
            "resamples": RESAMPLES,
            "changed": _changed(first, second),
            "rows": [
                {**_row_as_json(row), "intervals": {metric: asdict(one) for metric, one in found.items()}}
                for row, found in pairs
            ],
            "speed_verdict": self._speed_verdict,
        }

    def _head(self) -> str:
        first = self.evaluations[0]
        facts = first.model.facts
        lines = [
            f"model   {in_one_line(facts['weights'])}, {facts['runtime']} on {facts['device']}, "
            f"{facts['precision']}, image size {first.settings.image_size}",
            f"data    {in_one_line(str(self.source))}: {len(first.images)} images, "
            f"{self._rows[0][0].objects} objects",
            f"speed   {_median_ms(first)} per image, the median of {len(first.times_ms)}",
            f"counted at confidence_threshold {_thresholds(first)} and IoU {MIN_IOU}",
        ]
        if self.classes.left_out:
            shown = ", ".join(in_one_line(name, 40) for name in self.classes.left_out[:_MAX_CONFUSED])
            lines.append(f"left out, not in the model or not selected by its settings: {shown}")
        if self.problems.counts:
            lines.append(f"not evaluated: {self.problems.summary}")
        return "".join(f"{line}\n" for line in lines)

    def _speed_line(self) -> str:
        first, second = self.evaluations
        if not self._speed_verdict:
            return ""
        words = {"better": "faster", "worse": "slower"}
        verdict = words.get(self._speed_verdict, self._speed_verdict)
        changed = _changed(first, second)
        listed = "".join(f"OTHER has {name}={in_one_line(_text(value))}\n" for name, value in changed.items())
        return f"{listed}speed  {_median_ms(first)}, OTHER {_median_ms(second)}: {verdict}\n"


def _log_speed(times_ms: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(-np.log(np.median(times_ms, axis=-1)))


def _write_json(path: Path, content: object, *, indent: int | None = None) -> None:
    text = json.dumps(content, indent=indent, allow_nan=False)
    path.write_text(f"{text}\n", encoding="utf-8")


def _without_nan(value: Any) -> Any:
    """`value` as JSON has it: None instead of NaN."""
    if isinstance(value, Mapping):
        return {name: _without_nan(one) for name, one in value.items()}
    if isinstance(value, (list, tuple)):
        return [_without_nan(one) for one in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _row_as_json(row: Row) -> dict[str, Any]:
    """Figures and counts of a class."""
    counts = asdict(row)
    figures = counts.pop("figures")
    return {**counts, "missed": row.objects - row.right, **figures}


def _text(value: object) -> str:
    """`value` of a setting as it is written after `--compare NAME=`."""
    return value if isinstance(value, str) else value_text(value)


def _changed(first: Evaluation, second: Evaluation) -> Mapping[str, Any]:
    """The settings of the second model that differ from those of the first."""
    one, other = first.settings.model_dump(mode="json"), second.settings.model_dump(mode="json")
    return {name: value for name, value in other.items() if value != one[name]}


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


def _median_ms(evaluation: Evaluation) -> str:
    if not len(evaluation.times_ms):
        return "unknown"
    return f"{float(np.median(evaluation.times_ms)):.1f} ms"


def table(rows: Sequence[Row]) -> str:
    """Figures of all classes together and of each that has objects or detections, in columns."""
    shown = [row for row in rows if row.objects or row.right or row.wrong]
    cells = [["class", "images", "objects", *_HEADS.values()]] + [
        [_named(row.name), str(row.images), str(row.objects), *map(_shown, row.figures.values())]
        for row in shown
    ]
    absent = len(rows) - len(shown)
    return _aligned(cells) + (
        f"{absent} more classes have neither objects nor detections\n" if absent else ""
    )


def comparison_table(
    names: Sequence[str], differences: Sequence[Mapping[str, Interval]], shown: Sequence[str]
) -> str:
    """For each class and each metric of `shown`: both models, the interval of the difference, the verdict."""
    cells = [["class", "figure", "WEIGHTS", "OTHER", "difference, 95 %", "OTHER is"]]
    for name, of_class in zip(names, differences, strict=True):
        for metric in shown:
            found = of_class[metric]
            if found.verdict:
                both = f"{found.difference_low:+.3f} to {found.difference_high:+.3f}"
                figures = [_shown(found.first), _shown(found.second), both, found.verdict]
                cells.append([_named(name), _HEADS[metric], *figures])
    return _aligned(cells)


def confusion_table(counts: NDArray[np.int64], names: Sequence[str]) -> str:
    """Numbers of objects of each class, a row each, by what they were detected as."""
    cells = [["object \\ detected as", *map(_named, names), "nothing"]]
    for name, row in zip([*names, "no object"], counts.tolist(), strict=True):
        cells.append([_named(name), *map(str, row)])
    cells[-1][-1] = ""
    return _aligned(cells)


def _shown(value: float) -> str:
    return f"{value:.3f}" if math.isfinite(value) else "-"


def _named(name: str) -> str:
    return in_one_line(name, _MAX_NAME)


def _aligned(cells: Sequence[Sequence[str]]) -> str:
    """Rows with columns of one width: texts to the left, numbers to the right."""
    columns = []
    for column in zip(*cells, strict=True):
        is_text = any(cell[:1].isalpha() for cell in column[1:])
        columns.append([f"{cell:{'<' if is_text else '>'}{max(map(len, column))}}" for cell in column])
    return "".join(f"{'  '.join(row).rstrip()}\n" for row in zip(*columns, strict=True))
