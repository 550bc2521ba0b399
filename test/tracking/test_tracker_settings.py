"""Invalid settings of the tracker are refused with the reason."""

from __future__ import annotations

from typing import Any

import pytest

from yolov5_lifecycle.tracking.byte_tracker import MAX_TIMEOUT_S, TrackerSettings

NAN = float("nan")


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        pytest.param(
            {"track_high_threshold": 1.1}, r"track_high_threshold must be in \[0, 1\], found 1.1", id="high"
        ),
        pytest.param({"track_high_threshold": NAN}, "found nan", id="high is no number"),
        pytest.param(
            {"track_low_threshold": 0.3}, r"to track_high_threshold \(0.25\), found 0.3", id="low above high"
        ),
        pytest.param({"track_low_threshold": -0.1}, "found -0.1", id="low below 0"),
        pytest.param({"track_match_threshold": 0.0}, r"must be in \(0, 1\], found 0.0", id="match"),
        pytest.param({"track_match_threshold": NAN}, "found nan", id="match is no number"),
        pytest.param({"track_timeout": 0.0}, "at most 60 seconds, found 0.0", id="no timeout"),
        pytest.param({"track_timeout": float("inf")}, "found inf", id="endless timeout"),
        pytest.param(
            {"track_camera_motion": "on"}, "must be 'auto' or 'off', found 'on'", id="camera motion"
        ),
        pytest.param({"track_timeout": NAN}, "found nan", id="timeout is no number"),
    ],
)
def test_a_value_out_of_range_is_refused(values: dict[str, Any], expected: str) -> None:
    with pytest.raises(ValueError, match=expected):
        TrackerSettings(**values)


@pytest.mark.parametrize(
    "values",
    [
        {},
        {"track_high_threshold": 1.0, "track_low_threshold": 1.0, "track_match_threshold": 1.0},
        {"track_high_threshold": 0.0, "track_low_threshold": 0.0, "track_timeout": MAX_TIMEOUT_S},
    ],
    ids=["default", "highest", "lowest"],
)
def test_a_value_in_range_is_accepted(values: dict[str, Any]) -> None:
    assert vars(TrackerSettings(**values)).items() >= values.items()
