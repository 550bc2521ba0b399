"""What `evaluate` writes: report, curves, and the detections and ground truth behind them."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.evaluation.curves import draw_confusion_matrix, draw_f1_curve, draw_pr_curve
from yolov5_lifecycle.evaluation.evaluated import EvaluatedImage
from yolov5_lifecycle.evaluation.matching import Matches, found_annotations, truth_dataset

_FIELDS = ("image_id", "category_id", "bbox", "score")


def write_files(
    folder: Path,
    report: Mapping[str, Any],
    *,
    matches: Matches,
    class_names: Sequence[str],
    threshold: float,
    confusion: NDArray[np.int64],
    confused: Sequence[str],
    images: Sequence[Sequence[EvaluatedImage]],
) -> None:
    """Write the files to the new `folder`; `images`: those of each model. Raises OSError."""
    folder.mkdir()
    _write_json(folder / "report.json", report, indent=2)
    truth = truth_dataset(images[0], class_names)
    truth["annotations"] = [
        {name: value for name, value in one.items() if name != "row"} for one in truth["annotations"]
    ]
    _write_json(folder / "ground_truth.json", truth)
    for name, found in zip(("detections.json", "detections_other.json"), images, strict=False):
        rows = found_annotations(found)
        _write_json(folder / name, [{field: row[field] for field in _FIELDS} for row in rows])
    draw_pr_curve(folder / "pr_curve.png", matches, class_names)
    draw_f1_curve(folder / "f1_curve.png", matches, class_names, threshold)
    draw_confusion_matrix(folder / "confusion_matrix.png", confusion, confused)


def _write_json(path: Path, content: object, *, indent: int | None = None) -> None:
    path.write_text(json.dumps(content, indent=indent, allow_nan=False) + "\n", encoding="utf-8")
