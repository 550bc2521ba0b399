"""What makes a frame worth keeping."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.candidates import CLASS_NAMES, found, rules

from yolov5_lifecycle.collecting.reason import Reason
from yolov5_lifecycle.collecting.rules import CollectRules
from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.detection.nms import WORTH_TELLING, Selection
from yolov5_lifecycle.detection.selection import ClassFilterError
from yolov5_lifecycle.settings.settings import Settings

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
        pytest.param({"score_margin": 0.0}, found(("cat", 0.25, BOX)), {}, id="no margin"),
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
        pytest.param({"classes": frozenset({1})}, found(("dog", 0.9, BOX)), {"class": "dog"}, id="a class"),
        pytest.param({"classes": frozenset({1})}, found(("cat", 0.9, BOX)), {}, id="another class"),
        pytest.param(
            {"classes": frozenset({1}), "score_margin": 0.0}, found(("dog", 0.2, BOX)), {}, id="not published"
        ),
        pytest.param(
            {},
            replace(found(), best_filtered=0.8),
            {"filtered": "0.80, but it does not count"},
            id="filtered",
        ),
        pytest.param({}, replace(found(), best_filtered=0.5), {}, id="filtered, but unsure"),
        pytest.param({"filtered_score": 0.0}, replace(found(), best_filtered=0.9), {}, id="filtered, off"),
    ],
)
def test_a_frame_has_its_reasons(
    changes: dict[str, object], detections: Detections, expected: dict[str, str]
) -> None:
    reasons = {reason.value: why.words for reason, why in rules(**changes).reasons(detections)}
    assert reasons == expected


def test_the_lower_the_scores_are_the_stronger_is_the_doubt() -> None:
    sure = found(("cat", 0.9, BOX), ("cat", 0.9, BOX), ("dog", 0.3, BOX))
    unsure = found(("cat", 0.5, BOX), ("cat", 0.4, BOX), ("dog", 0.3, BOX))
    strengths = [why.strength for each in (sure, unsure) for _, why in rules().reasons(each)]
    assert strengths == pytest.approx([0.3, 0.6])


def test_a_look_finds_more_and_reports_what_the_selection_does() -> None:
    extended = rules(selection=DOG_AT_07).extended(DOG_AT_07)
    assert extended.extra_threshold == pytest.approx(0.15)
    assert extended.with_embedding
    assert not extended.with_masks
    assert rules(segments=True).extended(DOG_AT_07).with_masks
    scores, classes = np.array([0.65, 0.3], np.float32), np.array([1, 0], np.int64)
    assert extended.admits(scores, classes).tolist() == DOG_AT_07.admits(scores, classes).tolist()


@pytest.mark.parametrize("threshold", [0.0, 0.1, 0.14])
def test_a_look_does_not_search_in_the_noise(threshold: float) -> None:
    found_with = rules(selection=Selection(confidence_threshold=threshold)).extended(Selection())
    assert found_with.extra_threshold == WORTH_TELLING


def test_a_tracker_keeps_its_lower_threshold() -> None:
    assert rules().extended(Selection().wider(0.05)).extra_threshold == 0.05


def test_changes_of_objects_count_if_they_are_asked_for() -> None:
    unsteady, appeared = (Reason.UNSTEADY, ""), (Reason.APPEARED, "")
    only = rules(unsteady=False)
    assert (only.wants(unsteady), only.wants(appeared)) == (False, True)
    only = rules(appeared=False)
    assert (only.wants(unsteady), only.wants(appeared)) == (True, False)


def test_the_rules_are_those_of_the_settings() -> None:
    settings = Settings(
        collect_classes=("dog",),
        collect_score_margin=0.2,
        collect_filtered_score=0.3,
        collect_unsteady=False,
        collect_appeared=False,
        collect_novelty=0.4,
        collect_duplicate_distance=0.01,
        collect_every=7,
        collect_gap_s=3.0,
        collect_per_minute=5.0,
        collect_jpeg_quality=50,
        collect_blank_regions=("0,0 1,0 1,1",),
    )
    made = made_of(settings)
    assert made.classes == {1}
    assert (made.score_margin, made.filtered_score, made.novelty) == (0.2, 0.3, 0.4)
    assert [made.unsteady, made.appeared, made.every] == [False, False, 7]
    assert (made.duplicate_distance, made.gap_s, made.per_minute) == (0.01, 3.0, 5.0)
    assert made.jpeg_quality == 50
    assert [*made.blank_regions[0].points_xy] == [(0, 0), (1, 0), (1, 1)]
    assert made.configuration == settings.digest()


def test_a_class_that_the_model_does_not_have_is_refused() -> None:
    with pytest.raises(ClassFilterError, match="bird"):
        made_of(Settings(collect_classes=("bird",)))


def made_of(settings: Settings) -> CollectRules:
    return CollectRules.of(
        settings, Selection(), camera="front", class_names=CLASS_NAMES, segments=True, weights_sha256=""
    )
