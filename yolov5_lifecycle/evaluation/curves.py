"""Curves as PNG files: precision over recall, and F1 over the confidence threshold."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.evaluation.figures import RECALLS, Counts, mean_of_classes, sweep
from yolov5_lifecycle.evaluation.matching import Matches
from yolov5_lifecycle.printable import in_one_line

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MAX_NAMED = 10
"""With more classes each is a grey line without a name."""
MAX_NUMBERED = 20
"""With more classes the confusion matrix has no numbers and names."""
_SIZE_INCHES = (7.0, 4.6)
_DPI = 110
_MAX_NAME = 30
_CONFIDENCES = np.linspace(0, 1, 1001)


def draw_pr_curve(path: Path, matches: Matches) -> None:
    """Draw precision over recall at IoU 0.5, as average precision is computed from it. Raises OSError."""
    precision = np.where(matches.precision[0] < 0, np.nan, matches.precision[0])  # (101, classes)
    label = f"all, mAP {float(mean_of_classes(matches.ap50)):.3f}"
    with _axes(path, "Precision over recall, IoU 0.5", "recall", "precision") as axes:
        _draw_classes(axes, RECALLS, precision.T, matches.ap50, matches.class_names)
        axes.plot(RECALLS, mean_of_classes(precision), color="black", linewidth=2.5, label=label)
        _finish(axes)


def draw_f1_curve(path: Path, matches: Matches, threshold: float) -> None:
    """Draw F1 over the confidence threshold, with a line at the `threshold` that is set. Raises OSError."""
    each = np.array([_f1(*sweep(matches, number)) for number in range(len(matches.class_names))])
    together = _f1(*sweep(matches))
    label = f"all, {float(np.nan_to_num(together).max()):.3f}"
    with _axes(path, "F1 over confidence threshold, IoU 0.5", "confidence threshold", "F1") as axes:
        _draw_classes(axes, _CONFIDENCES, each, each.max(axis=1), matches.class_names)
        axes.plot(_CONFIDENCES, together, color="black", linewidth=2.5, label=label)
        axes.axvline(threshold, color="black", linestyle=":", linewidth=1, label=f"set, {threshold:g}")
        _finish(axes)


def draw_confusion_matrix(
    path: Path, objects: Sequence[str], detected_as: Sequence[str], counts: Sequence[Sequence[int]]
) -> None:
    """Draw the matrix with the labels of its rows and columns. Raises OSError.

    Rows are in shares of their sums, with numbers and names if there is room.
    """
    numbers = np.array(counts, np.int64)
    shares = numbers / np.maximum(numbers.sum(axis=1, keepdims=True), 1)
    with _axes(path, "Confusion at the set thresholds, IoU 0.5", "detected as", "object") as axes:
        axes.imshow(shares, cmap="Blues", vmin=0, vmax=1, aspect="auto")
        if len(objects) > MAX_NUMBERED + 1:
            return
        for (row, column), count in np.ndenumerate(numbers):
            colour = "white" if shares[row, column] > 0.5 else "black"
            axes.text(column, row, str(count), ha="center", va="center", color=colour, fontsize=8)
        rows, columns = (
            [_plain(in_one_line(name, _MAX_NAME)) for name in each] for each in (objects, detected_as)
        )
        axes.set_xticks(range(len(columns)), columns, rotation=30, ha="right")
        axes.set_yticks(range(len(rows)), rows)


def _f1(scores: NDArray[np.float64], counts: Counts) -> NDArray[np.float64]:
    """F1 at each of _CONFIDENCES; NaN without objects."""
    if not counts.objects:
        return np.full(len(_CONFIDENCES), np.nan)
    lowest_above = np.searchsorted(-scores, -_CONFIDENCES, side="left") - 1
    return np.append(counts.f1, 0.0)[lowest_above]  # -1, no detection, is the last


def _draw_classes(
    axes: Axes,
    xs: NDArray[np.float64],
    curves: NDArray[np.float64],
    figures: NDArray[np.float64],
    class_names: Sequence[str],
) -> None:
    """The curve of each class whose figure is not NaN; its name and figure are its label."""
    known = np.flatnonzero(np.isfinite(figures)).tolist()
    for number, class_id in enumerate(known):
        if len(known) > MAX_NAMED:
            axes.plot(xs, curves[class_id], linewidth=0.6, color="0.7")
            continue
        label = _plain(f"{in_one_line(class_names[class_id], _MAX_NAME)}, {figures[class_id]:.3f}")
        axes.plot(xs, curves[class_id], linewidth=1.3, color=f"C{number}", label=label)


def _finish(axes: Axes) -> None:
    """What both curves have: limits, grid and legend."""
    axes.set(xlim=(0, 1), ylim=(0, 1.02))
    axes.grid(color="0.9")
    axes.legend(loc="center left", bbox_to_anchor=(1.01, 0.5), frameon=False)


def _plain(label: str) -> str:
    """`label` without what matplotlib interprets: formulas, and a leading underscore, which would hide it."""
    text = label.replace("$", r"\$")
    return f" {text}" if text.startswith("_") else text


@contextmanager
def _axes(path: Path, title: str, x_label: str, y_label: str) -> Iterator[Axes]:
    """Axes to draw on; written to `path` as a PNG file at the end."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=_SIZE_INCHES, dpi=_DPI, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    yield axes
    axes.set(title=title, xlabel=x_label, ylabel=y_label)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # the font may lack letters of a class name
        canvas.print_png(str(path), metadata={"Software": None})  # type: ignore[no-untyped-call]
