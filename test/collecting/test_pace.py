"""How often frames may be kept."""

from __future__ import annotations

import pytest

from yolov5_lifecycle.collecting.pace import Pace


def kept_in(seconds: float, *, gap_s: float, per_minute: float, step_s: float = 0.1) -> list[float]:
    """When frames are kept of which one arrives every `step_s`."""
    pace, times = Pace(), []
    for index in range(round(seconds / step_s)):
        now_s = 1000 + index * step_s
        if pace.allows(now_s, gap_s=gap_s, per_minute=per_minute):
            pace.kept(now_s, per_minute=per_minute)
            times.append(now_s - 1000)
    return times


def test_without_limits_every_frame_is_kept() -> None:
    assert len(kept_in(10, gap_s=0, per_minute=0)) == 100


def test_frames_have_the_gap_between_them() -> None:
    times = kept_in(10, gap_s=2.0, per_minute=0)
    assert times == pytest.approx([0, 2, 4, 6, 8], abs=0.11)


def test_no_minute_has_more_than_twice_the_limit_and_an_hour_has_no_more_than_the_rate() -> None:
    times = kept_in(3600, gap_s=0, per_minute=10)
    assert 590 <= len(times) <= 611
    assert all(later - earlier > 58 for earlier, later in zip(times, times[20:], strict=False))


def test_a_burst_is_kept_after_a_pause() -> None:
    pace = Pace()
    for _ in range(3):
        pace.kept(0.0, per_minute=3)
    assert not pace.allows(1.0, gap_s=0, per_minute=3)
    assert pace.allows(21.0, gap_s=0, per_minute=3)


def test_a_limit_that_comes_later_counts_from_then_on() -> None:
    pace = Pace()
    for second in range(100):
        pace.kept(float(second), per_minute=0)
    assert pace.allows(100.0, gap_s=0, per_minute=1)
    pace.kept(100.0, per_minute=1)
    assert not pace.allows(101.0, gap_s=0, per_minute=1)
