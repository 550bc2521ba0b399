"""The figures as a table and as JSON."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.evaluation.bootstrap import Interval
from yolov5_lifecycle.evaluation.figures import METRICS, Row
from yolov5_lifecycle.evaluation.thresholds import Threshold
from yolov5_lifecycle.printable import in_one_line

HEADS = {"precision": "precision", "recall": "recall", "f1": "F1", "ap50": "mAP@50", "ap50_95": "mAP@50:95"}
_MAX_NAME = 40


def table(rows: Sequence[Row]) -> str:
    """Figures of all classes together and of each that has objects or detections, in columns."""
    cells = [["class", "images", "objects", *HEADS.values()]]
    shown = [row for row in rows if row.counts.objects or row.counts.right or row.counts.wrong]
    for row in shown:
        figures = [_shown(row.figures[name]) for name in METRICS]
        cells.append([_named(row.name), str(row.images), str(row.counts.objects), *figures])
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
                both = f"{found.low:+.3f} to {found.high:+.3f}"
                figures = [_shown(found.first), _shown(found.second), both, found.verdict]
                cells.append([_named(name), HEADS[metric], *figures])
    return _aligned(cells)


def confusion_table(counts: NDArray[np.int64], names: Sequence[str]) -> str:
    """Numbers of objects of each class, a row each, by what they were detected as."""
    cells = [["object \\ detected as", *map(_named, names), "nothing"]]
    for name, row in zip([*names, "no object"], counts.tolist(), strict=True):
        cells.append([_named(name), *map(str, row)])
    cells[-1][-1] = ""
    return _aligned(cells)


def row_as_json(row: Row) -> dict[str, Any]:
    """Figures and counts of a class; None where there is no figure."""
    return {
        "name": row.name,
        "images": row.images,
        "objects": row.counts.objects,
        "right": row.counts.right,
        "wrong": row.counts.wrong,
        "missed": row.counts.objects - row.counts.right,
        **{name: number(value) for name, value in row.figures.items()},
    }


def intervals_as_json(differences: Mapping[str, Interval]) -> dict[str, Any]:
    return {
        metric: {
            "first": number(found.first),
            "second": number(found.second),
            "difference_low": number(found.low),
            "difference_high": number(found.high),
            "verdict": found.verdict or None,
        }
        for metric, found in differences.items()
    }


def threshold_as_json(threshold: Threshold) -> dict[str, Any]:
    counts = threshold.counts
    return {
        "name": threshold.name,
        "threshold": threshold.value,
        "precision": number(counts.precision),
        "recall": number(counts.recall),
        "f1": number(counts.f1),
    }


def number(value: float) -> float | None:
    """`value` as JSON has it: None instead of NaN."""
    return value if math.isfinite(value) else None


def _shown(value: float) -> str:
    return f"{value:.3f}" if math.isfinite(value) else "-"


def _named(name: str) -> str:
    return in_one_line(name, _MAX_NAME)


def _aligned(cells: Sequence[Sequence[str]]) -> str:
    """Rows with columns of one width: texts to the left, numbers to the right."""
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    is_text = [any(cell[:1].isalpha() for cell in column[1:]) for column in zip(*cells, strict=True)]
    lines = (
        "  ".join(
            cell.ljust(width) if text else cell.rjust(width)
            for cell, width, text in zip(row, widths, is_text, strict=True)
        )
        for row in cells
    )
    return "".join(f"{line.rstrip()}\n" for line in lines)
