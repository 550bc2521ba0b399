"""When a frame of a camera is looked at, what makes it worth keeping, and what is offered."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from support.candidates import CAT, SIZE_HW, found, look_of, rules

from yolov5_lifecycle.collecting.candidate import GAP_S, Candidate, Detail, Origin, Trigger, value_of
from yolov5_lifecycle.collecting.collector import LOOK_PERIOD_S, CameraCollecting, Collector
from yolov5_lifecycle.collecting.descriptors import MIN_IMAGES
from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.detection.nms import WORTH_TELLING, Selection
from yolov5_lifecycle.images.image import ColourImage

IMAGE = ColourImage(np.zeros((*SIZE_HW, 3), np.uint8), "bgr")


class Offered(Collector):
    """Notes what is offered, and keeps all of it at once."""

    def __init__(self) -> None:
        super().__init__(lambda: pytest.fail("no folder is needed"))
        self.candidates: list[Candidate] = []

    def offer(self, candidate: Candidate) -> None:
        self.candidates.append(candidate)


class Camera:
    """A camera of 30 Hz whose frames are detected as the collecting wants it."""

    def __init__(self, **changes: Any) -> None:
        self.now_s = 1000.0
        self.offered = Offered()
        self.looks: list[bool] = []
        self.collecting = CameraCollecting(self.offered, rules(**changes), clock=lambda: self.now_s)

    def frame(self, published: Detections = CAT, **changes: Any) -> None:
        """Detect in the next frame."""
        wanted = self.collecting.wanted(Selection())
        self.looks.append(wanted.with_embedding)
        embedding = look_of(len(self.looks)) if wanted.with_embedding else None
        whole = replace(published, **{"embedding": embedding, **changes})
        self.collecting.look(whole, published, IMAGE, None, Origin("f", 1, 2))
        self.now_s += 1 / 30

    @property
    def reasons(self) -> list[dict[str, str]]:
        return [
            {trigger.value: detail.words for trigger, detail in each.reasons.items()}
            for each in self.offered.candidates
        ]


def test_frames_are_looked_at_five_times_a_second_at_most() -> None:
    camera = Camera()
    for _ in range(90):
        camera.frame()
    assert 12 <= sum(camera.looks) <= 3 / LOOK_PERIOD_S
    assert len(camera.offered.candidates) == sum(camera.looks)  # each may be novel


def test_in_the_gap_after_a_kept_frame_none_is_looked_at() -> None:
    camera = Camera()
    camera.frame()
    camera.collecting.pace.keep("1.jpg", camera.now_s)
    for _ in range(2):
        camera.now_s += 0.6 * GAP_S
        camera.frame()
    assert camera.looks == [True, False, True]


def test_a_frame_that_is_asked_for_is_looked_at_in_the_gap_and_once() -> None:
    camera = Camera(reasons=())
    camera.frame()
    camera.collecting.pace.keep("1.jpg", camera.now_s)
    camera.collecting.request()
    camera.frame()
    camera.frame()
    assert camera.looks == [True, True, False]
    assert camera.reasons == [{"requested": "~/collect"}]


def test_without_a_reason_nothing_is_offered_unless_it_may_be_novel() -> None:
    camera = Camera(reasons=("uncertain", "unusual"))
    for _ in range(30):
        camera.frame()
    assert camera.offered.candidates == []


@pytest.mark.parametrize("reasons", [["unusual"], []])
def test_an_image_that_looks_unlike_the_usual_ones_is_a_reason(reasons: list[str]) -> None:
    camera = Camera(reasons=tuple(reasons))
    for index in range(MIN_IMAGES + 1):
        camera.collecting.request()
        camera.frame(embedding=look_of(0) + np.float32(0.1) * look_of(index))
    camera.collecting.request()
    camera.frame(embedding=look_of(1))
    assert [*camera.reasons[-1]] == ["requested", *reasons]


def test_a_candidate_has_what_is_published_and_the_reasons_of_what_was_found() -> None:
    camera = Camera(reasons=("uncertain",))
    camera.frame(CAT, scores=np.array([0.2], np.float32))
    (candidate,) = camera.offered.candidates
    assert candidate.detections is CAT
    assert [trigger.value for trigger in candidate.reasons] == ["uncertain"]
    assert candidate.origin == Origin("f", 1, 2)


def test_new_rules_count_from_the_next_frame_on() -> None:
    camera = Camera(reasons=())
    camera.frame()
    camera.collecting.rules = rules(reasons=("class: cat",))
    for _ in range(9):
        camera.frame()
    assert camera.reasons == [{"class": "cat"}]


BOX = (20, 15, 40, 35)
DOG_AT_07 = Selection(class_thresholds=((1, 0.7),))


@pytest.mark.parametrize(
    ("changes", "detections", "expected"),
    [
        pytest.param({}, found(), {}, id="nothing found"),
        pytest.param(
            {}, found(("cat", 0.3, BOX)), {"uncertain": "cat 0.30, threshold 0.25"}, id="just above"
        ),
        pytest.param(
            {}, found(("cat", 0.2, BOX)), {"uncertain": "cat 0.20, threshold 0.25"}, id="just below"
        ),
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
    assert (
        extended.above_thresholds(scores, classes).tolist()
        == DOG_AT_07.above_thresholds(scores, classes).tolist()
    )
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
