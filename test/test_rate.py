"""Rates and latencies."""

from __future__ import annotations

import math

import pytest

from yolov5_lifecycle.rate import LatencyWindow, RateLimit


@pytest.mark.parametrize("limit_hz", [1.0, 7.0, 10.0, 20.0, 29.0])
def test_a_stream_is_thinned_to_the_limit_within_two_percent(limit_hz: float) -> None:
    limit = RateLimit()
    admitted = sum(limit.admits(1000 + index / 30, limit_hz) for index in range(30 * 100))
    assert admitted / 100 == pytest.approx(limit_hz, rel=0.02)


def test_a_slower_stream_passes_whole() -> None:
    limit = RateLimit()
    assert all(limit.admits(index / 5, 10.0) for index in range(100))


def test_zero_is_no_limit() -> None:
    limit = RateLimit()
    assert all(limit.admits(0.0, 0.0) for _ in range(10))


def test_a_pause_does_not_save_up_a_burst() -> None:
    limit = RateLimit()
    limit.admits(0.0, 10.0)
    admitted = sum(limit.admits(100 + index / 1000, 10.0) for index in range(100))
    assert admitted <= 2


def test_an_empty_window_has_no_latency() -> None:
    summary = LatencyWindow().summary(5.0)
    assert summary.rate_hz == 0
    assert math.isnan(summary.median_ms)
    assert math.isnan(summary.p95_ms)


def test_the_window_summarises_recent_events_only() -> None:
    window = LatencyWindow(window_s=10.0)
    window.add(0.0, 1e6)
    for index in range(1, 101):
        window.add(100.0, float(index))
    summary = window.summary(105.0)
    assert summary.rate_hz == pytest.approx(10.0)
    assert summary.median_ms == pytest.approx(50.5)
    assert summary.p95_ms == pytest.approx(96.0)
