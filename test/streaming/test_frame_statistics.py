"""Rates, latencies and runs of frames without detections."""

from __future__ import annotations

import math

import pytest

from yolov5_lifecycle.streaming.frame_statistics import (
    EmptyFrames,
    EmptyRun,
    LatencyWindow,
)


def test_an_empty_window_has_no_latency() -> None:
    summary = LatencyWindow().summary(5.0)
    assert summary.rate_hz == 0
    assert math.isnan(summary.median_ms)
    assert math.isnan(summary.p95_ms)


def test_the_window_summarises_recent_events_only() -> None:
    window = LatencyWindow(window_s=10.0, begin_s=0.0)
    window.add(0.0, 1e6)
    for index in range(1, 101):
        window.add(100.0, float(index))
    summary = window.summary(105.0)
    assert summary.rate_hz == pytest.approx(10.0)
    assert summary.median_ms == pytest.approx(50.5)
    assert summary.p95_ms == pytest.approx(96.0)


@pytest.mark.parametrize(
    "now_s", [101.0, 105.0, 200.0], ids=["after a second", "when it is full", "ever after"]
)
def test_the_rate_is_right_from_the_beginning(now_s: float) -> None:
    window = LatencyWindow(begin_s=100.0)
    window.add(100.0, 1.0)
    assert math.isfinite(window.summary(100.0).rate_hz)
    for index in range(30 * 100):
        if (at_s := 100 + (index + 0.5) / 30) <= now_s:
            window.add(at_s, 1.0)
    assert window.summary(now_s).rate_hz == pytest.approx(30.0, rel=0.04)


def test_empty_frames_are_counted_until_something_is_found() -> None:
    frames = EmptyFrames()
    assert frames.run == EmptyRun()
    assert (frames.run.frames, frames.run.duration_s) == (0, 0.0)
    for now_s, best_missed, best_filtered in ((3.0, 0.1, 0.8), (4.0, 0.4, 0.9), (6.0, 0.0, 0.0)):
        frames.add(now_s, 0, best_missed=best_missed, best_filtered=best_filtered)
    assert (frames.run.frames, frames.run.duration_s) == (3, 3.0)
    assert (frames.run.best_missed, frames.run.best_filtered) == (0.4, 0.9)
    frames.add(7.0, 1, best_missed=0.0)
    assert frames.run == EmptyRun()
