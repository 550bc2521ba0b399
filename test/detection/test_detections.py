"""Detections are validated on construction."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.detection.masks import Masks

GOOD: dict[str, Any] = {
    "boxes_xyxy": np.array([[1, 2, 3, 4], [5, 6, 5, 6]], np.float32),
    "scores": np.array([1, 0], np.float32),
    "class_ids": np.array([0, 7], np.int64),
}


@pytest.mark.parametrize(
    ("track_ids", "told"),
    [pytest.param((), ("", ""), id="no tracker"), pytest.param(("", "7"), ("", "7"), id="tracker")],
)
def test_objects_have_the_ids_of_their_tracks(track_ids: tuple[str, ...], told: tuple[str, ...]) -> None:
    found = Detections(**GOOD, track_ids=track_ids).objects([*"abcdefgh"])
    assert tuple(one.track_id for one in found) == told


@pytest.mark.parametrize(
    ("column", "values", "reason"),
    [
        pytest.param("boxes_xyxy", np.zeros((1, 4), np.float32), r"\(2, 4\)", id="a box too few"),
        pytest.param("boxes_xyxy", np.zeros((2, 5), np.float32), r"\(2, 4\)", id="five columns"),
        pytest.param("boxes_xyxy", np.full((2, 4), np.nan, np.float32), "finite", id="NaN box"),
        pytest.param("boxes_xyxy", np.array([[3, 2, 1, 4]] * 2, np.float32), "x1 <= x2", id="x exchanged"),
        pytest.param("scores", np.array([1.5, 0.5], np.float32), r"\[0, 1\]", id="score above 1"),
        pytest.param("scores", np.array([0.5, np.nan], np.float32), r"\[0, 1\]", id="NaN score"),
        pytest.param("scores", np.array([0.1, 0.2], np.float32), "best first", id="worse one first"),
        pytest.param("class_ids", np.array([0, 1], np.int32), "int64", id="class ids of another dtype"),
        pytest.param("class_ids", np.array([0, -1]), "negative", id="negative class id"),
        pytest.param("track_ids", ("1",), "none or 2, found 1", id="a track id too few"),
    ],
)
def test_a_bad_column_is_refused_by_name(column: str, values: object, reason: str) -> None:
    with pytest.raises(ValueError, match=f"(?s){column}.*{reason}"):
        Detections(**GOOD | {column: values})


@pytest.mark.parametrize(
    ("rows", "class_ids"),
    [
        pytest.param(np.array([False, True]), [7], id="mask"),
        pytest.param(slice(None), [0, 7], id="slice"),
        pytest.param(np.array([], np.int64), [], id="none"),
    ],
)
def test_some_rows_are_taken_with_all_their_columns(rows: Any, class_ids: list[int]) -> None:
    masks = Masks(np.zeros((2, 4, 4), np.float32), np.array([[0, 0], [7, 7]], np.float32), (8, 8))
    found = Detections(**GOOD, best_missed=0.1, track_ids=("t0", "t7"), masks=masks, best_filtered=0.2)[rows]
    assert found.class_ids.tolist() == class_ids
    assert found.track_ids == tuple(f"t{class_id}" for class_id in class_ids)
    assert found.masks is not None
    assert found.masks.coefficients[:, 0].tolist() == class_ids
    assert (found.best_missed, found.best_filtered) == (0.1, 0.2)
