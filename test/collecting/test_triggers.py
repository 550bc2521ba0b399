"""What makes a frame worth keeping, and how often."""

from __future__ import annotations

import numpy as np
import pytest
from support.candidates import found, rules

from yolov5_lifecycle.collecting.triggers import Detail, Pace, Trigger, value_of
from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.detection.nms import WORTH_TELLING, Selection

BOX = (20, 15, 40, 35)
DOG_AT_07 = Selection(class_thresholds=((1, 0.7),))


@pytest.mark.parametrize(
    ("changes", "detections", "expected"),
    [
        pytest.param({}, found(), {}, id="nothing found"),
        pytest.param({}, found(("cat", 0.9, BOX)), {}, id="sure"),
        pytest.param(
            {}, found(("cat", 0.3, BOX)), {"uncertain": "cat 0.30, threshold 0.25"}, id="just above"
        ),
        pytest.param(
            {}, found(("cat", 0.2, BOX)), {"uncertain": "cat 0.20, threshold 0.25"}, id="just below"
        ),
        pytest.param({}, found(("cat", 0.14, BOX)), {}, id="far below"),
        pytest.param({"reasons": ("novel",)}, found(("cat", 0.25, BOX)), {}, id="nobody asked"),
        pytest.param(
            {},
            found(("cat", 0.9, BOX), ("dog", 0.3, BOX), ("dog", 0.24, BOX)),
            {"uncertain": "dog 0.24, threshold 0.25, and 1 more"},
            id="the closest",
        ),
        pytest.param(
            {"selection": DOG_AT_07},
            found(("dog", 0.65, BOX), ("cat", 0.6, BOX)),
            {"uncertain": "dog 0.65, threshold 0.7"},
            id="the threshold of its class",
        ),
        pytest.param({"reasons": ("class: dog",)}, found(("dog", 0.9, BOX)), {"class": "dog"}, id="a class"),
        pytest.param({"reasons": ("class: 1",)}, found(("dog", 0.9, BOX)), {"class": "dog"}, id="an index"),
        pytest.param({"reasons": ("class: dog",)}, found(("cat", 0.9, BOX)), {}, id="another class"),
        pytest.param({"reasons": ("class: dog",)}, found(("dog", 0.2, BOX)), {}, id="not published"),
    ],
)
def test_a_frame_has_its_reasons(
    changes: dict[str, object], detections: Detections, expected: dict[str, str]
) -> None:
    reasons = {trigger.value: detail.words for trigger, detail in rules(**changes).reasons(detections)}
    assert reasons == expected


def test_the_lower_the_scores_are_the_stronger_is_the_doubt() -> None:
    sure = found(("cat", 0.9, BOX), ("cat", 0.9, BOX), ("dog", 0.3, BOX))
    unsure = found(("cat", 0.5, BOX), ("cat", 0.4, BOX), ("dog", 0.3, BOX))
    strengths = [detail.strength for each in (sure, unsure) for _, detail in rules().reasons(each)]
    assert strengths == pytest.approx([0.3, 0.6])


def test_an_image_is_worth_what_its_best_reason_is() -> None:
    doubt, novelty = {Trigger.UNCERTAIN: Detail("", 0.5)}, {Trigger.NOVEL: Detail("")}
    assert value_of({**doubt, **novelty}) == value_of(doubt) > value_of(novelty)
    order = (Trigger.REQUESTED, Trigger.CLASS, Trigger.UNCERTAIN, Trigger.NOVEL)
    values = [value_of({trigger: Detail("")}) for trigger in order]
    assert values == sorted(values, reverse=True)


def test_a_look_finds_more_and_reports_what_the_selection_does() -> None:
    extended = rules(selection=DOG_AT_07).extended(DOG_AT_07)
    assert extended.extra_threshold == pytest.approx(0.15)
    assert extended.with_embedding
    assert not extended.with_masks
    assert rules(segments=True).extended(DOG_AT_07).with_masks
    scores, classes = np.array([0.65, 0.3], np.float32), np.array([1, 0], np.int64)
    assert extended.admits(scores, classes).tolist() == DOG_AT_07.admits(scores, classes).tolist()
    assert rules(reasons=()).extended(Selection()).extra_threshold == 0.25


@pytest.mark.parametrize("threshold", [0.0, 0.1, 0.14])
def test_a_look_does_not_search_in_the_noise(threshold: float) -> None:
    found_with = rules(selection=Selection(confidence_threshold=threshold)).extended(Selection())
    assert found_with.extra_threshold == WORTH_TELLING


def test_a_tracker_keeps_its_lower_threshold() -> None:
    assert rules().extended(Selection().wider(0.05)).extra_threshold == 0.05


def test_a_class_that_the_model_does_not_have_is_refused() -> None:
    with pytest.raises(ValueError, match="bird"):
        [*rules(reasons=("class: bird",)).reasons(found())]


@pytest.mark.parametrize(("per_minute", "gap_s"), [(0.0, 0.5), (6000.0, 0.5), (20.0, 3.0)])
def test_kept_frames_have_a_gap_between_them(per_minute: float, gap_s: float) -> None:
    pace, limited = Pace(), rules(per_minute=per_minute)
    assert pace.allows(0.0, limited)
    pace.kept_s = 100.0
    assert [pace.allows(100 + later_s, limited) for later_s in (gap_s - 0.01, gap_s)] == [False, True]
