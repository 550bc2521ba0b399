"""The figures of one or two evaluations, as text for the terminal and as JSON."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from yolov5_lifecycle.evaluation.bootstrap import (
    RESAMPLES,
    SEED,
    Interval,
    differences,
    drawn_weights,
    interval,
    resampled,
)
from yolov5_lifecycle.evaluation.confusion import MIN_IOU, confusion_matrix, occurring
from yolov5_lifecycle.evaluation.evaluated import MIN_CONFIDENCE, EvaluatedClasses
from yolov5_lifecycle.evaluation.figures import Row, rows
from yolov5_lifecycle.evaluation.ground_truth import Problems
from yolov5_lifecycle.evaluation.matching import MAX_DETECTIONS, Matches, match
from yolov5_lifecycle.evaluation.report import (
    comparison_table,
    confusion_table,
    intervals_as_json,
    number,
    row_as_json,
    table,
    threshold_as_json,
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


class EvaluationResult:
    """The figures of `evaluations` of one data set; a second one is compared with the first."""

    def __init__(
        self,
        source: Path,
        kind: str,
        classes: EvaluatedClasses,
        evaluations: Sequence[Evaluation],
        problems: Problems,
        goal: Goal | None,
    ) -> None:
        self._source = source
        self._kind = kind
        self._classes = classes
        self._evaluations = evaluations
        self._problems = problems
        self._goal = goal
        self._thresholds = [evaluation.thresholds for evaluation in evaluations]
        self.matches: list[Matches] = [match(one.images, classes.names) for one in evaluations]
        self.confusion, self.confused = occurring(
            confusion_matrix(evaluations[0].images, self.matches[0], self._thresholds[0]), classes.names
        )

    @cached_property
    def _rows(self) -> list[list[Row]]:
        """For each evaluation the figures of all classes, then of each."""
        return [
            rows(matches, self._classes.names, thresholds)
            for matches, thresholds in zip(self.matches, self._thresholds, strict=True)
        ]

    @cached_property
    def _differences(self) -> list[dict[str, Interval]]:
        """For all classes, then for each, the intervals by metric; empty without a comparison."""
        if len(self._evaluations) < 2:
            return []
        count = len(self._evaluations[0].images)
        weights = drawn_weights(count)
        samples = [
            resampled(matches, thresholds, weights)
            for matches, thresholds in zip(self.matches, self._thresholds, strict=True)
        ]
        return differences(samples[0], samples[1], list(zip(*self._rows, strict=True)), count)

    @cached_property
    def _speed(self) -> Interval | None:
        """Logarithm of the median speed of both models; None without a comparison or times."""
        if len(self._evaluations) < 2 or not len(self._evaluations[0].times_ms):
            return None
        first, second = (evaluation.times_ms for evaluation in self._evaluations)
        rng = np.random.default_rng(SEED)
        drawn = rng.integers(0, len(first), (RESAMPLES, len(first)))
        medians = [np.log(np.median(times[drawn], axis=1)) for times in (first, second)]
        # Shorter is better; a small difference is due to the moment rather than to the models.
        return interval(
            -medians[0],
            -medians[1],
            -float(np.log(np.median(first))),
            -float(np.log(np.median(second))),
            len(first),
            margin=_SPEED_MARGIN,
        )

    @cached_property
    def _chosen(self) -> list[Threshold]:
        if self._goal is None:
            return []
        return chosen_thresholds(self.matches[0], self._classes.names, self._goal)

    def text(self, node: str) -> str:
        """What is printed; `node`: the full name of the node that thresholds are for."""
        parts = [self._head(), table(self._rows[0])]
        if len(self.confused) <= _MAX_CONFUSED:
            parts.append(confusion_table(self.confusion, self.confused))
        if self._differences:
            names = [row.name for row in self._rows[0]]
            parts.append(comparison_table(names, self._differences, _COMPARED) + self._speed_line())
        if self._goal is not None:
            parts.append(threshold_yaml(self._chosen, self._goal, node))
        return "\n".join(parts)

    def as_json(self) -> dict[str, Any]:
        """What report.json has; docs/evaluation.md explains it."""
        first = self._evaluations[0]
        report: dict[str, Any] = {
            "format": FORMAT,
            "data": {
                "path": str(self._source),
                "kind": self._kind,
                "images": len(first.images),
                "objects": self._rows[0][0].counts.objects,
                "classes_left_out": list(self._classes.left_out),
                "problems": {"counts": dict(self._problems.counts), "first": self._problems.first},
            },
            "model": _model(first),
            "evaluation": {
                "iou": MIN_IOU,
                "min_confidence": MIN_CONFIDENCE,
                "max_detections_per_class": MAX_DETECTIONS,
            },
            "all": row_as_json(self._rows[0][0]),
            "classes": [row_as_json(row) for row in self._rows[0][1:]],
            "confusion_matrix": {
                "objects": [*self.confused, "no object"],
                "detected_as": [*self.confused, "nothing"],
                "counts": self.confusion.tolist(),
            },
        }
        if self._differences:
            report["comparison"] = self._comparison()
        if self._goal is not None:
            chosen = [threshold_as_json(one) for one in self._chosen]
            report["thresholds"] = {"goal": str(self._goal), "all": chosen[0], "classes": chosen[1:]}
        return report

    def _comparison(self) -> dict[str, Any]:
        first, second = self._evaluations
        pairs = zip(self._rows[1], self._differences, strict=True)
        return {
            "model": _model(second),
            "resamples": RESAMPLES,
            "changed": _changed(first, second),
            "rows": [{**row_as_json(row), "intervals": intervals_as_json(found)} for row, found in pairs],
            "speed_verdict": self._speed.verdict if self._speed else None,
        }

    def _head(self) -> str:
        first = self._evaluations[0]
        facts = first.model.facts
        lines = [
            f"model   {in_one_line(facts['weights'])}, {facts['runtime']} on {facts['device']}, "
            f"{facts['precision']}, image size {first.settings.image_size}",
            f"data    {in_one_line(str(self._source))}: {len(first.images)} images, "
            f"{self._rows[0][0].counts.objects} objects",
            f"speed   {_median_ms(first)} per image, the median of {len(first.times_ms)}",
            f"counted at confidence_threshold {_thresholds(first)} and IoU {MIN_IOU}",
        ]
        if self._classes.left_out:
            shown = ", ".join(in_one_line(name, 40) for name in self._classes.left_out[:_MAX_CONFUSED])
            lines.append(f"left out, not in the model or not selected by its settings: {shown}")
        if self._problems.counts:
            lines.append(f"not evaluated: {self._problems.summary}")
        return "".join(f"{line}\n" for line in lines)

    def _speed_line(self) -> str:
        first, second = self._evaluations
        if self._speed is None:
            return ""
        words = {"better": "faster", "worse": "slower"}
        verdict = words.get(self._speed.verdict, self._speed.verdict)
        changed = _changed(first, second)
        listed = "".join(f"OTHER has {name}={in_one_line(_text(value))}\n" for name, value in changed.items())
        return f"{listed}speed  {_median_ms(first)}, OTHER {_median_ms(second)}: {verdict}\n"


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
            "median": number(float(np.median(times_ms))) if len(times_ms) else None,
            "p95": number(float(np.quantile(times_ms, 0.95))) if len(times_ms) else None,
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
