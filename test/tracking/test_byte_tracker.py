"""What gets an id, which one, and for how long."""

from __future__ import annotations

import itertools
from collections.abc import Iterable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.settings.settings import Settings
from yolov5_lifecycle.tracking.byte_tracker import (
    MAX_DETECTIONS,
    MAX_LATE_S,
    MAX_TRACKS,
    ByteTracker,
    StampCounts,
)

SETTINGS = Settings()
START_S = 1.7e9
HIGH, LOW = 0.8, 0.15
CLASS = 3
Row = tuple[float, float, float, int]
"""x, y, score, class id of an object of 50 x 80 pixels."""


def found(*rows: Row, size: tuple[float, float] = (50, 80)) -> Detections:
    """Detections in the order of `rows`, which must be the one of their scores."""
    x, y, scores, class_ids = np.array(rows, np.float64).reshape(-1, 4).T
    boxes = np.stack((x, y, x + size[0], y + size[1]), axis=1).astype(np.float32)
    return Detections(boxes, scores.astype(np.float32), class_ids.astype(np.int64))


def one(x: float, score: float = HIGH, class_id: int = CLASS) -> Detections:
    return found((x, 100.0, score, class_id))


class Camera:
    """A tracker and its clock."""

    def __init__(self, ids: Iterable[int] | None = None, settings: Settings = SETTINGS) -> None:
        self.counts = StampCounts()
        self.tracker = ByteTracker(iter(ids) if ids is not None else itertools.count(1), self.counts)
        self.settings = settings
        self.stamp_s = START_S

    def sees(self, detections: Detections, after_s: float = 0.1) -> tuple[str, ...]:
        self.stamp_s += after_s
        return self.tracker.update(detections, stamp_s=self.stamp_s, settings=self.settings)


@pytest.fixture
def camera() -> Camera:
    return Camera()


@pytest.fixture
def following() -> Camera:
    """A camera that tracks an object at x = 100 with the id 1."""
    camera = Camera()
    assert [camera.sees(one(100)) for _ in range(5)] == [("",), *[("1",)] * 4]
    return camera


def test_ids_are_in_the_order_of_the_detections(camera: Camera) -> None:
    rows = [(0.0, 0.0, 0.9, 0), (200.0, 0.0, 0.8, 0), (400.0, 0.0, 0.7, 1)]
    camera.sees(found(*rows))
    first = camera.sees(found(*rows))
    assert sorted(first) == ["1", "2", "3"]
    exchanged = [(400.0, 0.0, 0.9, 1), (0.0, 0.0, 0.8, 0), (200.0, 0.0, 0.7, 0)]
    assert camera.sees(found(*exchanged)) == (first[2], first[0], first[1])


def test_trackers_that_share_a_counter_share_no_id() -> None:
    ids = itertools.count(1)
    cameras = Camera(ids), Camera(ids)
    given = [camera.sees(one(100)) for _ in range(3) for camera in cameras][2:]
    assert given == [("1",), ("2",)] * 2


@pytest.mark.parametrize(("score", "expected"), [(LOW, "1"), (0.05, "")], ids=["low", "below low"])
def test_a_low_score_continues_a_track(following: Camera, score: float, expected: str) -> None:
    assert following.sees(one(100, score)) == (expected,)
    assert following.sees(one(100)) == ("1",)


def test_a_low_score_begins_no_track(camera: Camera) -> None:
    assert [camera.sees(one(100, LOW)) for _ in range(3)] == [("",)] * 3
    assert len(camera.tracker) == 0


def test_a_high_score_is_matched_before_a_low_one_that_fits_better(following: Camera) -> None:
    assert following.sees(found((110.0, 100.0, HIGH, CLASS), (100.0, 100.0, LOW, CLASS))) == ("1", "")


def test_a_confirmed_track_is_matched_before_an_unconfirmed_one_that_fits_better(following: Camera) -> None:
    following.sees(found((140.0, 100.0, HIGH, CLASS), (101.0, 100.0, HIGH - 0.1, CLASS)))
    assert following.sees(found((125.0, 100.0, HIGH, CLASS))) == ("1",)


def test_objects_of_two_classes_in_one_place_keep_their_ids(camera: Camera) -> None:
    def both(first: int, second: int) -> Detections:
        return found((100.0, 100.0, 0.9, first), (101.0, 100.0, 0.8, second))

    camera.sees(both(0, 1))
    assert camera.sees(both(0, 1)) == ("1", "2")
    assert camera.sees(both(1, 0)) == ("2", "1")


@pytest.mark.parametrize(
    ("across", "expected"),
    [pytest.param(False, "", id="within a class"), pytest.param(True, "1", id="across classes")],
)
def test_a_class_that_changes_continues_the_track_only_across_classes(
    following: Camera, across: bool, expected: str
) -> None:
    following.settings = Settings(track_across_classes=across)
    assert following.sees(one(100, class_id=CLASS + 1)) == (expected,)


@pytest.mark.parametrize("step_s", [0.03, 0.1, 0.2], ids=["33 Hz", "10 Hz", "5 Hz"])
def test_a_lost_track_is_kept_by_time_and_not_by_images(following: Camera, step_s: float) -> None:
    following.settings = Settings(track_timeout=1.01)  # no multiple of a step
    for _ in range(int(1.01 / step_s)):
        following.sees(found(), step_s)
        assert len(following.tracker) == 1
    following.sees(found(), step_s)
    assert len(following.tracker) == 0
    assert [following.sees(one(100), step_s) for _ in range(2)] == [("",), ("2",)]


@pytest.mark.parametrize(
    "jump_s", [-1.001, -1e6, 1.501, 1e6, 1e200], ids=["back", "far back", "gap", "long", "absurd"]
)
def test_a_jump_in_time_starts_afresh_and_uses_no_id_again(following: Camera, jump_s: float) -> None:
    assert following.sees(one(100), jump_s) == ("",)
    assert [following.sees(one(100)) for _ in range(2)] == [("2",)] * 2


@pytest.mark.parametrize("late_s", [1e-3, 0.25, MAX_LATE_S], ids=["a little", "some images", "the most"])
def test_a_late_image_has_no_ids_and_changes_nothing(following: Camera, late_s: float) -> None:
    following.stamp_s = 2.0**20  # where stamps are exact
    following.tracker.reset()
    assert [following.sees(one(100)) for _ in range(2)] == [("",), ("2",)]
    assert following.sees(found((100.0, 100.0, HIGH, CLASS), (400.0, 0.0, HIGH, CLASS)), -late_s) == ("", "")
    assert len(following.tracker) == 1
    assert following.sees(one(100), late_s + 0.1) == ("2",)


def test_late_images_and_jumps_back_are_counted(following: Camera) -> None:
    for step_s in (-0.5, 0.2, 1.0, -5.0, -0.1, -2.0):
        following.sees(one(100), step_s)
    assert (following.counts.late, following.counts.jumps) == (3, 2)
    assert following.counts.last_jump_s == pytest.approx(2.1)


def test_a_camera_without_stamps_is_tracked_and_forgets(camera: Camera) -> None:
    ids = [camera.sees(one(100 + 3 * number), 0) for number in range(60)]
    assert set(ids[1:]) == {("1",)}
    for _ in range(46):
        camera.sees(found(), 0)
    assert len(camera.tracker) == 0


@pytest.mark.parametrize("stamp_s", [float("nan"), float("inf"), float("-inf")])
def test_a_stamp_that_is_no_time_is_refused_and_changes_nothing(following: Camera, stamp_s: float) -> None:
    with pytest.raises(ValueError, match="stamp_s must be finite"):
        following.tracker.update(one(100), stamp_s=stamp_s, settings=SETTINGS)
    assert following.sees(one(100)) == ("1",)


def test_a_known_motion_of_the_camera_moves_the_tracks(camera: Camera) -> None:
    """By more than an object is wide, which boxes alone cannot tell from other objects."""
    shift = np.array(((1.0, 0, 150), (0, 1, 0)))
    for _ in range(5):
        camera.sees(one(100))
    camera.stamp_s += 0.1
    moved = one(250)
    ids = camera.tracker.update(moved, stamp_s=camera.stamp_s, settings=SETTINGS, camera=shift)
    assert ids == ("1",)


@pytest.mark.parametrize("size", [(0, 0), (0, 50), (50, 0)], ids=["point", "upright", "flat"])
def test_empty_boxes_are_tracked_like_others(camera: Camera, size: tuple[float, float]) -> None:
    rows = (5.0, 5.0, HIGH, 0), (300.0, 5.0, HIGH, 0)
    assert [camera.sees(found(*rows, size=size)) for _ in range(3)] == [("", ""), *[("1", "2")] * 2]


def random_crowd(rng: np.random.Generator, count: int) -> Detections:
    x, y = rng.uniform(0, 600, (2, count))
    scores = np.sort(rng.uniform(0.1, 1.0, count))[::-1]
    return found(*zip(x, y, scores, np.zeros(count, int), strict=True))


def test_detections_beyond_the_highest_scores_have_no_tracks(camera: Camera) -> None:
    rng = np.random.default_rng(0)
    for _ in range(4):
        ids = camera.sees(random_crowd(rng, MAX_DETECTIONS + 50))
        given = [name for name in ids if name]
        assert len(set(given)) == len(given)
        assert ids[MAX_DETECTIONS:] == ("",) * 50


def test_of_too_many_tracks_those_seen_last_are_kept(camera: Camera) -> None:
    """Three crowds one after the other, each as large as an image may have, none where another was."""
    camera.settings = Settings(track_timeout=60.0)
    crowds = [
        found(
            *(
                (200 * column, 4000 * crowd + 200 * row, HIGH, CLASS)
                for row in range(20)
                for column in range(50)
            )
        )
        for crowd in range(3)
    ]
    given = []
    for crowd in crowds:
        camera.sees(crowd)
        given.append(camera.sees(crowd))
    assert len(camera.tracker) == MAX_TRACKS == 2 * len(crowds[0])
    assert camera.sees(crowds[1]) == given[1]
    assert camera.sees(crowds[0]) == ("",) * len(crowds[0])


stamps = st.sampled_from((0.0, 0.02, 0.1, 0.3, 0.9, 1.6, -0.5, -1.5))
places = st.tuples(st.integers(0, 12), st.sampled_from((0.05, 0.1, 0.15, 0.25, 0.6, 0.9)), st.integers(0, 1))
images = st.lists(st.tuples(stamps, st.lists(places, max_size=5)), max_size=25)


@hypothesis_settings(deadline=None, max_examples=60)
@given(images=images)
def test_an_id_belongs_to_one_class_and_is_never_used_again(
    images: list[tuple[float, list[tuple[int, float, int]]]],
) -> None:
    camera = Camera()
    known: set[str] = set()
    classes: dict[str, int] = {}
    restarts, newest_s = 0, START_S
    restarts_before: dict[str, int] = {}
    for step_s, objects in images:
        rows = [(30.0 * x, 100.0, score, c) for x, score, c in sorted(objects, key=lambda row: -row[1])]
        ids = camera.sees(found(*rows), step_s)
        is_late = 0 < newest_s - camera.stamp_s <= MAX_LATE_S
        if not is_late:
            restarts += not 0 <= camera.stamp_s - newest_s <= SETTINGS.track_timeout
            newest_s = camera.stamp_s
        assert not (is_late and any(ids))
        given = [name for name in ids if name]
        assert len(ids) == len(rows)
        assert len(set(given)) == len(given)
        for name, (_, _, score, class_id) in zip(ids, rows, strict=True):
            if name:
                assert score >= np.float32(SETTINGS.track_low_threshold)
                assert classes.setdefault(name, class_id) == class_id
                assert restarts_before.setdefault(name, restarts) == restarts
                known.add(name)
    assert sorted(map(int, known)) == list(range(1, len(known) + 1))
