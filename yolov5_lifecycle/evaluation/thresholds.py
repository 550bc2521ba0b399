"""Confidence thresholds that reach a goal on the evaluated images, as parameters of the node."""

from __future__ import annotations

import json
import re
from argparse import ArgumentTypeError
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.evaluation.figures import METRICS, Counts, sweep
from yolov5_lifecycle.evaluation.matching import MIN_CONFIDENCE, Matches

_LEAST = re.compile(r"(recall|precision)=(0?\.\d+|1(?:\.0*)?)", re.ASCII)


@dataclass(frozen=True)
class Goal:
    """What a threshold is chosen for: the best F1, or a least recall or precision."""

    kind: Literal["f1", "recall", "precision"]
    least: float = 0.0

    @classmethod
    def parsed(cls, text: str) -> Goal:
        """The goal `f1`, `recall=0.9` or `precision=0.95`; raises ArgumentTypeError."""
        if text == "f1":
            return cls("f1")
        if (found := _LEAST.fullmatch(text)) and float(found[2]):
            return cls("recall" if found[1] == "recall" else "precision", float(found[2]))
        raise ArgumentTypeError(f"expected f1, recall=0.9 or precision=0.95, found {text[:40]!r}")

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

    @property
    def figures(self) -> dict[str, float]:
        """Precision, recall and F1; NaN where there is none."""
        return {name: float(getattr(self.counts, name)) for name in METRICS[:3]}


def chosen_thresholds(matches: Matches, goal: Goal) -> list[Threshold]:
    """The threshold of all classes together, then that of each."""
    together = _chosen("all", sweep(matches), goal)
    each = enumerate(matches.class_names)
    return [together, *(_chosen(name, sweep(matches, class_id), goal) for class_id, name in each)]


def _chosen(name: str, swept: tuple[NDArray[np.float64], Counts], goal: Goal) -> Threshold:
    scores, counts = swept
    if not len(scores) or not counts.objects:  # nothing to choose from
        nothing = np.zeros((), np.int64)
        return Threshold(name, None, Counts(nothing, nothing, counts.objects))
    values = np.nan_to_num(getattr(counts, goal.kind))
    reached = np.flatnonzero(values >= goal.least)
    best = int(values.argmax())
    if len(reached) and goal.kind == "recall":  # the fewest detections, and so the highest precision
        best = int(reached[0])
    elif len(reached) and goal.kind == "precision":  # the most detections, and so the highest recall
        best = int(reached[-1])
    chosen = Counts(counts.right[best], counts.wrong[best], counts.objects)
    return Threshold(name, _between(scores, best) if len(reached) else None, chosen)


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
    together, *classes = thresholds
    lines = [f"# Chosen for {goal}, on the evaluated images; on others it may be missed."]
    if any(one.value is not None for one in thresholds):
        lines += [f"{node}:", "  ros__parameters:"]
    if together.value is not None:
        lines.append(f"    confidence_threshold: {together.value:.12g}  # {_described(together)}")
    if reached := [one for one in classes if one.value is not None]:
        lines.append("    class_thresholds:")
    for one in reached:
        lines.append(f"      - {_quoted(f'{one.name}: {one.value:.12g}')}  # {_described(one)}")
    for one in thresholds:
        if one.value is None and one.counts.objects:
            lines.append(f"# {_quoted(one.name)}: out of reach, the closest is {_described(one)}")
    if absent := sum(not one.counts.objects for one in thresholds):
        lines.append(f"# Classes without objects, and so without a threshold: {absent}.")
    return "".join(f"{line}\n" for line in lines)


def _described(threshold: Threshold) -> str:
    words = {"precision": "precision", "recall": "recall", "f1": "F1"}
    figures = threshold.figures.items()
    return ", ".join(f"{words[name]} {value:.3f}" for name, value in figures if np.isfinite(value))


def _quoted(text: str) -> str:
    """`text` as a string of YAML on one line."""
    return json.dumps(text, ensure_ascii=not text.isprintable())
