"""IoU and assignment, against slow references."""

from __future__ import annotations

import itertools
import sys
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray
from support.started import printed_by

from yolov5_lifecycle.tracking.assignment import best_pairs, iou_matrix

Matrix = NDArray[np.float64]
sides = st.integers(0, 5)
similarities = arrays(
    np.float64, st.tuples(sides, sides), elements=st.sampled_from((0.0, 0.1, 0.19, 0.2, 0.35, 0.5, 0.9, 1.0))
)
corners = st.integers(-20, 20)
boxes = st.lists(
    st.tuples(corners, corners, st.integers(0, 20), st.integers(0, 20)).map(
        lambda box: (box[0], box[1], box[0] + box[2], box[1] + box[3])
    ),
    max_size=6,
).map(lambda rows: np.array(rows, np.float32).reshape(-1, 4))


def slow_iou(box: Sequence[float], other: Sequence[float]) -> float:
    """Of boxes with integer corners, by counting unit squares."""
    squares, others = (
        {(x, y) for x in range(int(b[0]), int(b[2])) for y in range(int(b[1]), int(b[3]))}
        for b in (box, other)
    )
    return len(squares & others) / len(squares | others) if squares | others else 0.0


@given(first=boxes, second=boxes)
def test_the_iou_is_that_of_counted_pixels(first: NDArray[np.float32], second: NDArray[np.float32]) -> None:
    expected = [[slow_iou(box, other) for other in second] for box in first]
    np.testing.assert_allclose(
        iou_matrix(first, second), np.reshape(expected, (len(first), len(second))), atol=1e-12
    )


def slow_best_sum(similarity: Matrix, threshold: float) -> float:
    """The largest sum of pairs of at least `threshold`, by trying all."""
    if similarity.shape[0] > similarity.shape[1]:
        similarity = similarity.T
    gated = np.where(similarity >= threshold, similarity, 0)
    rows = range(len(gated))
    return max(
        sum(float(gated[row, column]) for row, column in zip(rows, columns, strict=True))
        for columns in itertools.permutations(range(gated.shape[1]), len(gated))
    )


@given(similarity=similarities, threshold=st.sampled_from((0.15, 0.2, 0.5)))
def test_the_assignment_is_the_best_of_all(similarity: Matrix, threshold: float) -> None:
    everyone, everything = np.arange(similarity.shape[0]), np.arange(similarity.shape[1])
    rows, columns = best_pairs(similarity, everyone, everything, threshold)
    assert len(set(rows.tolist())) == len(set(columns.tolist())) == len(rows)
    assert (similarity[rows, columns] >= threshold).all()
    assert similarity[rows, columns].sum() == pytest.approx(slow_best_sum(similarity, threshold))


def test_without_scipy_the_tracker_is_refused_with_a_remedy() -> None:
    program = (
        "import sys, itertools; sys.modules['scipy'] = None\n"
        "from yolov5_lifecycle.tracking.byte_tracker import ByteTracker\n"
        "try:\n    ByteTracker(itertools.count(1))\n"
        "except ValueError as error:\n    print(error)\n"
    )
    told = printed_by(program)
    assert "cannot import what is needed" in told
    assert f"{sys.executable} -m pip install scipy" in told
