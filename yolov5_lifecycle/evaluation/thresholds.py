"""Confidence thresholds that reach a goal on the evaluated images, as parameters of the node."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.evaluation.evaluated import MIN_CONFIDENCE
from yolov5_lifecycle.evaluation.figures import Counts, Sweep, sweep
from yolov5_lifecycle.evaluation.matching import Matches


class GoalError(ValueError):
    """A text that is not a goal; the message lists the possible goals."""


@dataclass(frozen=True)
class Goal:
    """What a threshold is chosen for: the best F1, or a least recall or precision."""

    kind: Literal["f1", "recall", "precision"]
    least: float = 0.0

    @classmethod
    def parsed(cls, text: str) -> Goal:
        """The goal `f1`, `recall=0.9` or `precision=0.95`; raises GoalError."""
        kind, _, least = text.partition("=")
        if text == "f1":
            return cls("f1")
        try:
            value = float(least)
        except ValueError:
            value = float("nan")
        if kind not in ("recall", "precision") or not 0 < value <= 1:
            raise GoalError(f"expected f1, recall=0.9 or precision=0.95, found {text[:40]!r}")
        return cls("recall" if kind == "recall" else "precision", value)

    def __str__(self) -> str:
        return "the best F1" if self.kind == "f1" else f"{self.kind} of at least {self.least:g}"


@dataclass(frozen=True)
class Threshold:
    """A confidence threshold for `name`, and the counts with it."""

    name: str
    value: float | None
    """None if the goal is out of reach, or without objects."""
    counts: Counts
    """With `value`; without it, at the score that comes closest."""


def chosen_thresholds(matches: Matches, class_names: Sequence[str], goal: Goal) -> list[Threshold]:
    """The threshold of all classes together, then that of each."""
    together = _chosen("all", sweep(matches.classes), goal)
    each = zip(class_names, matches.classes, strict=True)
    return [together, *(_chosen(name, sweep([one]), goal) for name, one in each)]


def _chosen(name: str, counts: Sweep, goal: Goal) -> Threshold:
    if not counts.objects or not len(counts.scores):  # nothing to choose from
        return Threshold(name, None, Counts(0, 0, counts.objects))
    values = {"f1": counts.f1, "recall": counts.recall, "precision": counts.precision}[goal.kind]
    values = np.nan_to_num(values, nan=0.0)
    reached = np.flatnonzero(values >= goal.least) if goal.kind != "f1" else np.arange(0)
    if goal.kind == "recall":  # the fewest detections, and so the highest precision
        best = int(reached[0]) if len(reached) else len(values) - 1
    elif goal.kind == "precision":  # the most detections, and so the highest recall
        best = int(reached[-1]) if len(reached) else int(values.argmax())
    else:
        best = int(values.argmax())
    is_reached = len(reached) > 0 or goal.kind == "f1"
    return Threshold(
        name,
        _between(counts.scores, best) if is_reached else None,
        Counts(int(counts.right[best]), int(counts.wrong[best]), counts.objects),
    )


def _between(scores: NDArray[np.float64], last: int) -> float:
    """A threshold below the score number `last` and not below the next, with as few digits as possible."""
    upper = float(scores[last])
    # Below MIN_CONFIDENCE there may be detections that were not evaluated.
    lower = float(scores[last + 1]) if last + 1 < len(scores) else min(MIN_CONFIDENCE, upper / 2)
    for digits in range(2, 12):
        middle = round((lower + upper) / 2, digits)
        if lower <= middle < upper:
            return middle
    return lower


def threshold_yaml(thresholds: Sequence[Threshold], goal: Goal, node: str) -> str:
    """The thresholds and their figures as a parameter file of the node with the full name `node`."""
    head = f"# Chosen for {goal}, on the evaluated images; on others it may be missed.\n"
    missed = "".join(
        f"# {_quoted(one.name)}: out of reach, the closest is {_described(one.counts)}\n"
        for one in thresholds
        if one.value is None and one.counts.objects
    )
    absent = sum(not one.counts.objects for one in thresholds)
    if absent:
        missed += f"# Classes without objects, and so without a threshold: {absent}.\n"
    together, *classes = thresholds
    lines = []
    if together.value is not None:
        lines.append(f"confidence_threshold: {together.value:.12g}  # {_described(together.counts)}")
    reached = [one for one in classes if one.value is not None]
    if reached:
        lines.append("class_thresholds:")
        lines += [
            f"  - {_quoted(f'{one.name}: {one.value:.12g}')}  # {_described(one.counts)}" for one in reached
        ]
    if not lines:
        return head + missed
    return f"{head}{node}:\n  ros__parameters:\n" + "".join(f"    {line}\n" for line in lines) + missed


def _described(counts: Counts) -> str:
    shown = (
        f"{name} {value:.3f}"
        for name, value in (("precision", counts.precision), ("recall", counts.recall), ("F1", counts.f1))
        if np.isfinite(value)
    )
    return ", ".join(shown)


def _quoted(text: str) -> str:
    """`text` as a string of YAML on one line."""
    return json.dumps(text, ensure_ascii=not text.isprintable())
