"""What boxes have in common: a camera that sways, turns or stands still, without any image."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from yolov5_lifecycle.tracking.common_motion import MIN_BOXES, CommonMotion, Correction

Points = NDArray[np.float64]
SIZE_PX = 60.0
PLACES = np.array([(60, 60), (560, 80), (300, 240), (90, 400), (540, 420), (320, 60), (200, 330)], np.float64)
NOISE = np.random.default_rng(0).normal(0, 2, (200, *PLACES.shape))


def corrections(errors: Points, *, step_s: float = 0.1) -> list[Correction]:
    """For images whose predictions are off by each of `errors` (m, n, 2)."""
    common, given = CommonMotion(), []
    for error in errors:
        common.predict(step_s, SIZE_PX)
        correction = common.correct(PLACES, PLACES + error, SIZE_PX)
        assert correction is not None
        given.append(correction)
    return given


def mapped(correction: Correction, places: Points = PLACES) -> Points:
    return np.asarray(places @ correction.similarity[:, :2].T + correction.similarity[:, 2])


def test_a_camera_that_jerks_again_and_again_is_followed() -> None:
    errors = np.where(np.arange(40)[:, None, None] % 2, 15.0, -15.0) + NOISE[:40]
    last = corrections(errors)[-1]
    np.testing.assert_allclose(mapped(last), PLACES + 15, atol=4)


def test_a_camera_that_stands_still_moves_no_track() -> None:
    found = corrections(NOISE)
    shifts = np.array([mapped(each) - PLACES for each in found])
    assert np.abs(shifts).max() < 1.5
    assert np.abs([each.velocity_xy for each in found]).max() < 0.1 * SIZE_PX


def test_one_object_that_jumps_is_no_camera() -> None:
    errors = NOISE[:40].copy()
    errors[::2, 0] += 40
    shifts = np.array([mapped(each) - PLACES for each in corrections(errors)])
    assert np.abs(shifts[:, 1:]).max() < 2


@pytest.mark.parametrize(("degrees", "zoom"), [(4, 1.0), (-3, 1.0), (0, 1.06), (2, 0.96)])
def test_a_turn_and_a_zoom_are_followed_at_once(degrees: float, zoom: float) -> None:
    cos, sin = zoom * math.cos(math.radians(degrees)), zoom * math.sin(math.radians(degrees))
    middle = PLACES.mean(axis=0)
    seen = (PLACES - middle) @ np.array(((cos, sin), (-sin, cos))) + middle
    (correction,) = corrections((seen - PLACES)[None])
    np.testing.assert_allclose(mapped(correction), seen, atol=4)


def test_fewer_boxes_say_nothing_and_leave_no_uncertainty() -> None:
    common = CommonMotion()
    for _ in range(300):
        common.predict(1.0, SIZE_PX)
        few = PLACES[: MIN_BOXES - 1]
        assert common.correct(few, few + 30, SIZE_PX) is None
    assert common.variance_xy.tolist() == [0, 0]


@pytest.mark.parametrize("places", [np.zeros((6, 2)), np.full((6, 2), 1e30)], ids=["one place", "far"])
@pytest.mark.parametrize("step_s", [1e-9, 60.0], ids=["short", "long"])
def test_estimates_stay_finite(places: Points, step_s: float) -> None:
    common = CommonMotion()
    for number in range(50):
        common.predict(step_s, SIZE_PX)
        correction = common.correct(places, places + number, SIZE_PX)
        assert correction is not None
        assert np.isfinite(correction.similarity).all()
        assert np.isfinite(correction.velocity_xy).all()
        assert (common.variance_xy >= 0).all()
