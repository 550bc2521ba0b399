"""When a frame of a camera is looked at, and what is offered."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from support.candidates import CAT, SIZE_HW, look_of, rules

from yolov5_lifecycle.collecting.camera_collecting import LOOK_PERIOD_S, CameraCollecting
from yolov5_lifecycle.collecting.candidate import Candidate, Origin
from yolov5_lifecycle.collecting.collector import Collector
from yolov5_lifecycle.collecting.descriptors import MIN_IMAGES
from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.detection.nms import Selection
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
    camera = Camera(per_minute=60.0)
    camera.frame()
    camera.offered.candidates[0].pace.kept_s = camera.now_s
    for _ in range(29):
        camera.frame()
    assert camera.looks == [True] + [False] * 29
    for _ in range(5):
        camera.frame()
    assert sum(camera.looks) == 2


def test_a_frame_that_is_asked_for_is_looked_at_in_the_gap_and_once() -> None:
    camera = Camera(reasons=())
    camera.frame()
    camera.collecting.pace.kept_s = camera.now_s
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
