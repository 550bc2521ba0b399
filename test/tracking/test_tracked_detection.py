"""A tracker changes neither which detections are published nor their boxes; it adds identities."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from support.scripted_runtime import ScriptedRuntime

from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.detection.detector import Detector
from yolov5_lifecycle.detection.nms import Selection
from yolov5_lifecycle.images.image import ColourImage
from yolov5_lifecycle.images.region import BoxFilter, Region
from yolov5_lifecycle.settings.settings import Settings
from yolov5_lifecycle.sources.scene import cluttered_background
from yolov5_lifecycle.tracking.byte_tracker import TrackedDetection

LEFT = Region(((0.0, 0.0), (0.5, 0.0), (0.5, 1.0), (0.0, 1.0)))
IMAGE = ColourImage(np.zeros((64, 64, 3), np.uint8), "rgb")
scores = st.sampled_from((0.06, 0.15, 0.2, 0.3, 0.6, 0.9))
rows = st.tuples(*[st.integers(8, 56)] * 2, *[st.integers(2, 30)] * 2, scores, scores)


def detector_of(images: Sequence[NDArray[np.float32]]) -> Detector:
    """Predicts each of `images`, raw rows of two classes, in turn."""
    predictions = iter(images)
    runtime = ScriptedRuntime(lambda: next(predictions))
    return Detector(runtime, class_names=("cat", "dog"), image_size=64, stride=32)


def predicted(listed: Sequence[tuple[float, ...]]) -> NDArray[np.float32]:
    """Raw rows from centre, size and the scores of both classes."""
    raw = np.ones((len(listed), 7), np.float32)
    raw[:, [0, 1, 2, 3, 5, 6]] = np.array(listed, np.float32).reshape(-1, 6)
    return raw


def new_tracking(**changes: Any) -> TrackedDetection:
    tracking = TrackedDetection.started(Settings(tracker="bytetrack", **changes), itertools.count(1))
    assert tracking is not None
    return tracking


def found_in(
    images: Sequence[NDArray[np.float32]], selection: Selection, tracking: TrackedDetection | None = None
) -> list[Detections]:
    """What is published for `images` of 10 Hz."""
    detector, tracking = detector_of(images), tracking or new_tracking()
    return [tracking.detect(detector, IMAGE, selection, number / 10) for number in range(len(images))]


@hypothesis_settings(max_examples=20)
@given(
    listed=st.lists(st.lists(rows, max_size=8), min_size=1, max_size=4),
    selection=st.builds(
        Selection,
        confidence_threshold=st.sampled_from((0.05, 0.1, 0.25, 0.7)),
        max_detections=st.integers(1, 4),
        classes=st.sampled_from((None, frozenset({1}))),
        agnostic_nms=st.booleans(),
        class_thresholds=st.sampled_from(((), ((1, 0.06),), ((0, 0.5), (1, 0.15)))),
        box_filter=st.sampled_from((None, BoxFilter(regions=(LEFT,)), BoxFilter(min_box_size=12))),
    ),
)
def test_the_same_is_published_with_a_tracker_and_without(
    listed: list[list[tuple[float, ...]]], selection: Selection
) -> None:
    images = [predicted(each) for each in listed]
    plain = detector_of(images)
    for tracked in found_in(images, selection):
        expected = plain.detect(IMAGE, selection)
        np.testing.assert_array_equal(tracked.boxes_xyxy, expected.boxes_xyxy)
        np.testing.assert_array_equal(tracked.scores, expected.scores)
        np.testing.assert_array_equal(tracked.class_ids, expected.class_ids)
        assert len(tracked.track_ids) == len(expected)
        assert tracked.best_missed == expected.best_missed


def test_a_detection_that_is_not_published_continues_its_track() -> None:
    scores = (0.9, 0.9, 0.15, 0.15, 0.9)
    images = [predicted([(32, 32, 20, 20, score, 0)]) for score in scores]
    tracking = new_tracking(track_timeout=0.15)  # one missing image, not two
    assert [found.track_ids for found in found_in(images, Selection(), tracking)] == [
        ("",),
        ("1",),
        (),
        (),
        ("1",),
    ]


@pytest.mark.parametrize("threshold", [0.05, 0.25])
def test_the_network_is_asked_for_the_lower_of_the_two_thresholds(threshold: float) -> None:
    found = found_in([predicted([(32, 32, 20, 20, 0.08, 0)])] * 2, Selection(confidence_threshold=threshold))
    assert [len(each) for each in found] == [int(threshold < 0.08)] * 2


def jumping(count: int = 8) -> tuple[list[ColourImage], list[NDArray[np.float32]]]:
    """Images of 10 Hz from a camera that jumps from side to side, and the object in them."""
    world = cluttered_background(np.random.default_rng(3), (240, 480))
    shifts = [100 * (number % 2) for number in range(count)]
    images = [ColourImage(np.ascontiguousarray(world[:, x : x + 320]), "rgb") for x in shifts]
    return images, [predicted([((200 - x) / 5, 24, 8, 8, 0.9, 0)]) for x in shifts]


@pytest.mark.parametrize(("motion", "expected"), [("auto", {("1",)}), ("off", {("",)})], ids=["auto", "off"])
def test_a_camera_that_jumps_keeps_its_ids_if_its_motion_is_looked_for(
    motion: Literal["auto", "off"], expected: set[tuple[str, ...]]
) -> None:
    images, rows = jumping()
    detector, tracking = detector_of(rows), new_tracking(track_camera_motion=motion)
    ids = [
        tracking.detect(detector, image, Selection(), number / 10).track_ids
        for number, image in enumerate(images)
    ]
    assert set(ids[1:]) == expected


def test_the_motion_of_the_camera_may_be_switched_on_while_it_tracks() -> None:
    """The image before was not looked at, so the first motion is that of the next image."""
    images, rows = jumping(4)
    tracking = new_tracking(track_camera_motion="off")
    detector = detector_of([*rows[:2], *rows])
    for number in range(2):
        tracking.detect(detector, images[number], Selection(), number / 10)
    other = tracking.with_settings(Settings(track_camera_motion="auto"))
    assert other.tracker is tracking.tracker
    ids = [
        other.detect(detector, image, Selection(), 1 + number / 10).track_ids
        for number, image in enumerate(images)
    ]
    assert ids == [("",), ("1",), ("1",), ("1",)]
