"""Selection follows YOLOv5's rules, which a slow implementation spells out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from yolov5_lifecycle.detection.nms import (
    MAX_CANDIDATES,
    WORTH_TELLING,
    Selection,
    narrowed,
    select,
    suppress,
)

Row = tuple[float, ...]
Found = tuple[tuple[float, float, float, float], float, int]


def raw_rows(*rows: Row, classes: int = 2) -> NDArray[np.float32]:
    return np.array(rows, np.float32).reshape(-1, 5 + classes)


def found(raw: NDArray[np.float32], **selection: Any) -> list[Found]:
    """Boxes, scores and class ids that `select` gives."""
    detections = select(raw, Selection(**selection))
    columns = (detections.boxes_xyxy.tolist(), detections.scores.tolist(), detections.class_ids.tolist())
    return [
        ((x1, y1, x2, y2), score, class_id)
        for (x1, y1, x2, y2), score, class_id in zip(*columns, strict=True)
    ]


def reference_iou(a: Row, b: Row) -> float:
    width = min(a[2], b[2]) - max(a[0], b[0])
    height = min(a[3], b[3]) - max(a[1], b[1])
    both = max(width, 0.0) * max(height, 0.0)
    return both / ((a[2] - a[0]) * (a[3] - a[1]) + (b[2] - b[0]) * (b[3] - b[1]) - both)


def reference_select(
    raw: NDArray[np.float32], selection: Selection, is_counted: Callable[[Row], bool] = lambda box: True
) -> list[Found]:
    """One row, one box at a time."""
    candidates: list[Found] = []
    for cx, cy, w, h, objectness, *class_scores in raw:
        best = max(class_scores)
        class_id = class_scores.index(best)
        is_wanted = selection.classes is None or class_id in selection.classes
        threshold = dict(selection.class_thresholds).get(class_id, selection.confidence_threshold)
        if min(objectness, objectness * best) > threshold and is_wanted:
            box = (float(cx - w / 2), float(cy - h / 2), float(cx + w / 2), float(cy + h / 2))
            candidates.append((box, float(objectness * best), class_id))
    kept: list[Found] = []
    for box, score, class_id in sorted(candidates, key=lambda row: -row[1]):
        rivals = [other for other, _, other_id in kept if selection.agnostic_nms or other_id == class_id]
        if all(reference_iou(box, other) <= selection.iou_threshold for other in rivals):
            kept.append((box, score, class_id))
    return [one for one in kept if is_counted(one[0])][: selection.max_detections]


# Few values, so that equal scores and equal boxes happen; IoUs of these boxes are never just at a threshold.
scores = st.sampled_from([0.0, 0.125, 0.25, 0.5, 0.75, 1.0])
rows = st.tuples(
    *[st.integers(-20, 40).map(float)] * 2,
    *[st.integers(1, 30).map(float)] * 2,
    *[scores] * 4,
)
selections = st.builds(
    Selection,
    confidence_threshold=st.sampled_from([0.0, 0.1, 0.25, 0.5, 1.0]),
    iou_threshold=st.sampled_from([0.0, 0.2501237, 0.4501237, 0.7501237, 1.0]),
    max_detections=st.integers(1, 8),
    classes=st.none() | st.frozensets(st.integers(0, 3), max_size=2),
    agnostic_nms=st.booleans(),
    class_thresholds=st.just(())
    | st.dictionaries(st.integers(0, 2), st.sampled_from([0.0, 0.1, 0.5, 1.0])).map(
        lambda own: tuple(sorted(own.items()))
    ),
)
raws = st.lists(rows, max_size=15).map(lambda listed: raw_rows(*listed, classes=3))


@settings(deadline=None)
@given(raw=raws, selection=selections)
def test_the_selection_is_that_of_the_slow_one(raw: NDArray[np.float32], selection: Selection) -> None:
    before = raw.copy()
    assert found(raw, **vars(selection)) == reference_select(raw, selection)
    np.testing.assert_array_equal(raw, before)


@settings(deadline=None)
@given(raw=raws, selection=selections, limit=st.integers(-20, 60))
def test_boxes_that_do_not_count_suppress_others_but_take_no_place(
    raw: NDArray[np.float32], selection: Selection, limit: int
) -> None:
    detections = select(raw, selection, lambda boxes: boxes[:, 0] >= limit)
    expected = reference_select(raw, selection, lambda box: box[0] >= limit)
    assert detections.boxes_xyxy.tolist() == [list(box) for box, _, _ in expected]
    assert detections.scores.tolist() == [score for _, score, _ in expected]
    if not expected:
        everything = reference_select(raw, selection)
        assert detections.best_filtered == max((score for _, score, _ in everything), default=0.0)


LEFT = (10, 10, 4, 4)
RIGHT = (90, 10, 4, 4)


@pytest.mark.parametrize(
    ("rows", "selection", "best_missed", "best_filtered"),
    [
        pytest.param([(*LEFT, 0.5, 1.0, 0.0)], {}, 0.0, 0.5, id="filtered"),
        pytest.param([(*LEFT, 0.2, 1.0, 0.0)], {}, 0.0, 0.0, id="too low and filtered"),
        pytest.param([(*RIGHT, 0.5, 0, 1.0)], {"class_thresholds": ((1, 0.6),)}, 0.5, 0.0, id="missed"),
        pytest.param([(*LEFT, 0.5, 1.0, 0.0), (*RIGHT, 0.4, 1.0, 0.0)], {}, 0.0, 0.5, id="found"),
    ],
)
def test_why_nothing_is_found_is_reported(
    rows: list[Row], selection: dict[str, Any], best_missed: float, best_filtered: float
) -> None:
    found = select(raw_rows(*rows), Selection(**selection), lambda boxes: boxes[:, 0] > 50)
    assert found.best_missed == pytest.approx(best_missed)
    assert found.best_filtered == pytest.approx(best_filtered)


def test_many_boxes_that_do_not_count_leave_place_for_those_that_do() -> None:
    outside = [(20 * i, 0, 10, 10, 0.9, 1.0, 0.0) for i in range(3000)]
    inside = [(20 * i, 100, 10, 10, 0.5, 1.0, 0.0) for i in range(5)]
    found = select(raw_rows(*outside, *inside), Selection(max_detections=4), lambda boxes: boxes[:, 1] > 50)
    assert found.scores.tolist() == [0.5] * 4


@pytest.mark.parametrize(
    ("selection", "least"),
    [
        pytest.param({}, 0.25, id="usual"),
        pytest.param({"class_thresholds": ((1, 0.01),)}, 0.01, id="lower"),
        pytest.param({"class_thresholds": ((1, 0.6),), "classes": frozenset({1})}, 0.6, id="the only class"),
        pytest.param({"class_thresholds": ((1, 0.01),), "classes": frozenset({0})}, 0.25, id="not wanted"),
        pytest.param({"extra_threshold": 0.1}, 0.1, id="tracked"),
    ],
)
def test_the_network_is_asked_for_the_lowest_threshold_of_a_wanted_class(
    selection: dict[str, Any], least: float
) -> None:
    chosen = Selection(**selection)
    assert chosen.min_score == least
    assert chosen.min_objectness == min(least, WORTH_TELLING)


def test_what_only_a_tracker_wants_replaces_nothing_that_is_admitted() -> None:
    rows = [(10, 10, 10, 10, 0.4, 1.0, 0.0), (10, 10, 10, 10, 0.3, 0.0, 1.0)]
    selection = Selection(class_thresholds=((0, 0.5),), agnostic_nms=True, extra_threshold=0.1)
    assert select(raw_rows(*rows), selection).class_ids.tolist() == [1]
    one = replace(selection, agnostic_nms=False, max_detections=1)
    assert select(raw_rows(*rows), one).class_ids.tolist() == [1]
    both = select(raw_rows(*rows), replace(one, max_detections=2))
    assert both.class_ids.tolist() == [0, 1]  # best first


def test_what_is_reported_is_above_the_threshold_of_its_class_or_the_extra_one() -> None:
    scores = ((0, 0.07), (1, 0.06), (0, 0.15))
    rows = [
        (50 * (index + 1), 50, 10, 10, score, 1.0 - class_id, float(class_id))
        for index, (class_id, score) in enumerate(scores)
    ]
    selection = Selection(class_thresholds=((1, 0.05),), extra_threshold=0.1)
    assert select(raw_rows(*rows), selection).class_ids.tolist() == [0, 1]
    wider = select(raw_rows(*rows), selection.wider(0.05))
    assert wider.class_ids.tolist() == [0, 0, 1]
    assert narrowed(wider, selection).scores.tolist() == pytest.approx([0.15, 0.06])


def test_only_the_best_candidates_are_compared_with_the_regions() -> None:
    compared: list[int] = []

    def counts(boxes_xyxy: NDArray[np.float32]) -> NDArray[np.bool_]:
        compared.append(len(boxes_xyxy))
        return np.ones(len(boxes_xyxy), np.bool_)

    raw = np.tile(raw_rows((10, 10, 4, 4, 0.4, 1.0, 0.0)), (MAX_CANDIDATES + 1, 1))
    raw[-1, 4] = 0.45
    assert select(raw, Selection(confidence_threshold=0.5), counts).best_missed == pytest.approx(0.45)
    assert max(compared) == MAX_CANDIDATES


@pytest.mark.parametrize("size", [(100, 4), (4, 100)], ids=["wide", "high"])
def test_boxes_of_many_classes_stay_apart_whatever_their_shape(size: Row) -> None:
    raw = raw_rows(*[(0, 0, *size, 0.9, *np.eye(50)[class_id]) for class_id in range(50)], classes=50)
    assert len(found(raw, iou_threshold=0.0)) == 50


def test_only_the_best_candidates_enter_the_suppression() -> None:
    raw = np.tile(raw_rows((10, 10, 4, 4, 0.9, 1.0, 0.0)), (MAX_CANDIDATES + 1, 1))
    raw[0] = (90, 90, 4, 4, 0.5, 1.0, 0.0)
    assert [box for box, _, _ in found(raw)] == [(8, 8, 12, 12)]
    assert len(found(raw[:-1])) == 2


@pytest.mark.long
@settings(deadline=None)
@given(
    seed=st.integers(0, 100),
    places=st.integers(1, 300),
    limit=st.sampled_from([1, 5, 400, 600, 5000]),
)
def test_a_limit_gives_the_beginning_of_what_no_limit_gives(seed: int, places: int, limit: int) -> None:
    """Of more than a thousand boxes, the worse are looked at only when the better ones do not suffice."""
    rng = np.random.default_rng(seed)
    count = 2500
    corners = rng.integers(0, 2000, (places, 2))[rng.integers(0, places, count)] + rng.integers(
        0, 4, (count, 2)
    )
    boxes_xyxy = np.concatenate((corners, corners + 10), axis=1).astype(np.float32)
    groups = rng.integers(0, 5, count)
    everything = suppress(boxes_xyxy, groups=groups, iou_threshold=0.45, limit=count)
    kept = suppress(boxes_xyxy, groups=groups, iou_threshold=0.45, limit=limit)
    np.testing.assert_array_equal(kept, everything[:limit])


@pytest.mark.parametrize("shift_px", [0.0625, 0.1, 0.3, 1.3])
def test_a_high_class_id_does_not_blur_the_boxes(shift_px: float) -> None:
    boxes_xyxy = np.array([[0, 0, 99, 99], [0, 0, 99, 99], [shift_px, 0, 99 + shift_px, 99]], np.float32)
    iou = (99 - shift_px) / (99 + shift_px)
    for iou_threshold, kept in ((iou - 1e-5, [0, 1]), (iou + 1e-5, [0, 1, 2])):
        indices = suppress(
            boxes_xyxy,
            groups=np.array([9_999, 9_998, 9_999]),
            iou_threshold=iou_threshold,
            limit=9,
        )
        assert indices.tolist() == kept


@pytest.mark.parametrize("column", [4, 5, 6])
def test_a_score_that_is_nan_is_above_no_threshold(column: int) -> None:
    raw = raw_rows((10, 10, 4, 4, 0.9, 1.0, 0.5), (50, 50, 4, 4, 0.9, 0.5, 1.0))
    raw[0, column] = np.nan
    assert [box for box, _, _ in found(raw)] == [(48, 48, 52, 52)]


@pytest.mark.parametrize(("column", "value"), list(enumerate([np.nan, np.inf, -np.inf, np.nan])))
def test_a_box_that_is_not_finite_is_refused(column: int, value: float) -> None:
    raw = raw_rows((10, 10, 4, 4, 0.9, 1.0, 0.5), (50, 50, 4, 4, 0.9, 0.5, 1.0))
    raw[0, column] = value
    with pytest.raises(ValueError, match="finite"):
        select(raw, Selection())
