"""The figures as tables."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.evaluation.bootstrap import Interval
from yolov5_lifecycle.evaluation.figures import Row
from yolov5_lifecycle.printable import in_one_line

_HEADS = {"precision": "precision", "recall": "recall", "f1": "F1", "ap50": "mAP@50", "ap50_95": "mAP@50:95"}
_MAX_NAME = 40


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
