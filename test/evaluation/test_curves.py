"""Curves are drawn for any classes, names and data."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest
from support.random_evaluation import random_images

from yolov5_lifecycle.evaluation.curves import (
    MAX_NAMED,
    MAX_NUMBERED,
    draw_confusion_matrix,
    draw_f1_curve,
    draw_pr_curve,
)
from yolov5_lifecycle.evaluation.figures import confusion_matrix, occurring
from yolov5_lifecycle.evaluation.matching import match

STRANGE = ("_hidden", "$x^", "猫", "a\nb\x1b[31m", "x" * 300)


@pytest.mark.long
@pytest.mark.parametrize(
    ("names", "images"),
    [
        pytest.param(("cat",), 5, id="one class"),
        pytest.param(STRANGE, 20, id="strange names"),
        pytest.param(tuple(map(str, range(MAX_NAMED + 1))), 20, id="many classes"),
        pytest.param(tuple(map(str, range(MAX_NUMBERED + 5))), 40, id="very many classes"),
    ],
)
def test_curves_are_pictures(names: Sequence[str], images: int, tmp_path: Path) -> None:
    evaluated = random_images(1, images, classes=len(names))
    matches = match(evaluated, names)
    counts, confused = occurring(confusion_matrix(evaluated, matches, np.full(len(names), 0.3)), names)
    draw_pr_curve(tmp_path / "pr.png", matches)
    draw_f1_curve(tmp_path / "f1.png", matches, 0.25)
    draw_confusion_matrix(tmp_path / "confusion.png", counts, confused)
    assert sorted(file.name for file in tmp_path.iterdir()) == ["confusion.png", "f1.png", "pr.png"]
    for file in tmp_path.iterdir():
        picture = cv2.imread(str(file))
        assert min(picture.shape[:2]) > 400
        assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 20
