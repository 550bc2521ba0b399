"""What is published of tracked detections is what the threshold alone would give."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.detection.nms import Selection, select
from yolov5_lifecycle.tracking.published import published

LOW = 0.1
levels = st.sampled_from([0.0, 0.06, 0.125, 0.25, 0.3, 0.5, 0.75, 1.0])
rows = st.tuples(*[st.integers(0, 40)] * 2, *[st.integers(1, 30)] * 2, levels, levels, levels)
selections = st.builds(
    Selection,
    confidence_threshold=st.sampled_from([0.11, 0.25, 0.5, 1.0]),
    iou_threshold=st.sampled_from([0.0, 0.2501237, 0.4501237, 1.0]),
    max_detections=st.integers(1, 8),
    agnostic_nms=st.booleans(),
)


@settings(deadline=None)
@given(listed=st.lists(rows, max_size=15), selection=selections)
def test_the_published_detections_are_those_of_their_threshold(
    listed: list[tuple[float, ...]], selection: Selection
) -> None:
    raw = np.array(listed, np.float32).reshape(-1, 7)
    tracked = select(raw, replace(selection, confidence_threshold=LOW))
    ids = [str(row) for row in range(len(tracked))]
    found = published(tracked, ids, selection.confidence_threshold)
    expected = select(raw, selection)
    np.testing.assert_array_equal(found.boxes_xyxy, expected.boxes_xyxy)
    np.testing.assert_array_equal(found.scores, expected.scores)
    np.testing.assert_array_equal(found.class_ids, expected.class_ids)
    assert found.best_missed == expected.best_missed
    assert found.track_ids == tuple(ids[: len(found)])


def test_a_missed_score_that_is_noise_is_not_told() -> None:
    noise = Detections(np.zeros((1, 4), np.float32), np.array([0.03], np.float32), np.zeros(1, np.int64))
    found = published(noise, [""], 0.25)
    assert (len(found), found.best_missed, found.track_ids) == (0, 0.0, ())
