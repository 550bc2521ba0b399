"""Curves are drawn for any classes, names and data, into one file and nothing else."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest
from support.random_evaluation import random_images

from yolov5_lifecycle.evaluation.confusion import confusion_matrix, occurring
from yolov5_lifecycle.evaluation.curves import (
    MAX_NAMED,
    MAX_NUMBERED,
    draw_confusion_matrix,
    draw_f1_curve,
    draw_pr_curve,
    matplotlib_problem,
)
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
        pytest.param(("cat", "dog"), 0, id="no images"),
    ],
)
def test_curves_are_pictures(names: Sequence[str], images: int, tmp_path: Path) -> None:
    before = dict(os.environ)
    evaluated = random_images(1, images, classes=len(names))
    matches = match(evaluated, names)
    counts, confused = occurring(confusion_matrix(evaluated, matches, np.full(len(names), 0.3)), names)
    draw_pr_curve(tmp_path / "pr.png", matches, names)
    draw_f1_curve(tmp_path / "f1.png", matches, names, 0.25)
    draw_confusion_matrix(tmp_path / "confusion.png", counts, confused)
    assert sorted(file.name for file in tmp_path.iterdir()) == ["confusion.png", "f1.png", "pr.png"]
    assert all(cv2.imread(str(file)).shape[1] > 400 for file in tmp_path.iterdir())
    assert dict(os.environ) == before


def test_matplotlib_is_there_and_its_folder_stays_as_the_user_has_set_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MPLCONFIGDIR", str(tmp_path))
    assert matplotlib_problem() == ""
    assert os.environ["MPLCONFIGDIR"] == str(tmp_path)
