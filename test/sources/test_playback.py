"""Playing images: when each is shown, and what becomes of a source that ends, fails or hangs."""

from __future__ import annotations

import itertools
import re
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np
import pytest

from yolov5_lifecycle.images.image import ColourImage
from yolov5_lifecycle.sources.frames import ImageSource, Playback, SourceError, SourceFrame

PATIENCE_S = 60.0


def frame(number: int) -> SourceFrame:
    return SourceFrame(ColourImage(np.full((1, 1, 3), number % 256, np.uint8), "rgb"))


def numbers(frames: list[SourceFrame]) -> list[int]:
    return [int(shown.image.pixels[0, 0, 0]) for shown in frames]


@contextmanager
def playback(
    open_source: Callable[[], ImageSource],
    show: Callable[[SourceFrame], None] = lambda _: None,
    *,
    rate_hz: float = 0.0,
    is_awaited: Callable[[], bool] = lambda: True,
) -> Iterator[Playback]:
    playing = Playback(open_source, show, rate_hz=rate_hz, is_awaited=is_awaited)
    yield playing
    assert playing.stop(PATIENCE_S)


def wait_for_end(playing: Playback) -> None:
    deadline_s = time.monotonic() + PATIENCE_S
    while not playing.is_finished:
        assert time.monotonic() < deadline_s
        time.sleep(0.01)


@pytest.mark.parametrize(
    ("own_hz", "asked_hz", "at_least_s"),
    [
        pytest.param(20.0, 0.0, 0.15, id="its own rate"),
        pytest.param(1.0, 20.0, 0.15, id="another rate"),
    ],
)
def test_frames_are_shown_in_order_and_no_faster_than_asked(
    own_hz: float, asked_hz: float, at_least_s: float
) -> None:
    shown: list[SourceFrame] = []
    begun_s = time.monotonic()
    source = ImageSource(map(frame, range(4)), own_hz)
    with playback(lambda: source, shown.append, rate_hz=asked_hz) as playing:
        wait_for_end(playing)
    assert numbers(shown) == [0, 1, 2, 3]
    assert time.monotonic() - begun_s >= at_least_s
    assert playing.failure == ""


@pytest.mark.parametrize(("rate_hz", "is_every_one_shown"), [(0.0, True), (20.0, False)])
def test_a_device_is_read_at_its_own_pace_and_what_is_too_much_is_dropped(
    rate_hz: float, is_every_one_shown: bool
) -> None:
    shown: list[SourceFrame] = []
    enough = threading.Event()

    def show(frame: SourceFrame) -> None:
        shown.append(frame)
        if len(shown) == 3:
            enough.set()

    device = ImageSource(map(frame, itertools.count()), rate_hz=None)
    with playback(lambda: device, show, rate_hz=rate_hz):
        assert enough.wait(PATIENCE_S)
    assert (numbers(shown[:3]) == [0, 1, 2]) is is_every_one_shown


def one_frame() -> ImageSource:
    return ImageSource(map(frame, range(1)), 1000.0)


def test_nothing_is_shown_before_it_is_awaited_and_what_nobody_awaits_can_be_stopped() -> None:
    awaited, shown = threading.Event(), threading.Event()
    with playback(one_frame, lambda _: shown.set(), is_awaited=awaited.is_set) as playing:
        assert not shown.wait(0.1)
        awaited.set()
        wait_for_end(playing)
    assert shown.is_set()
    with playback(one_frame, is_awaited=lambda: False) as playing:
        assert not playing.is_finished


def test_a_source_that_hangs_is_abandoned() -> None:
    is_repaired = threading.Event()

    def hang() -> ImageSource:
        is_repaired.wait(PATIENCE_S)
        return ImageSource(map(frame, range(1)), 1000.0)

    shown: list[SourceFrame] = []
    with playback(hang, shown.append) as playing:
        assert not playing.stop(0.1)
        is_repaired.set()
    assert shown == []


def failing() -> Iterator[SourceFrame]:
    yield frame(0)
    raise SourceError("unplugged")


def absent() -> ImageSource:
    raise SourceError("no such file")


@pytest.mark.parametrize(
    ("open_source", "show", "told"),
    [
        pytest.param(absent, lambda _: None, "no such file", id="no source"),
        pytest.param(lambda: ImageSource(failing(), 9e3), lambda _: None, "unplugged", id="source"),
        pytest.param(one_frame, lambda _: 1 / 0, "Traceback.*ZeroDivisionError.*", id="anything else"),
    ],
)
def test_a_failure_ends_the_playback_and_is_reported(
    open_source: Callable[[], ImageSource], show: Callable[[SourceFrame], None], told: str
) -> None:
    with playback(open_source, show) as playing:
        wait_for_end(playing)
    assert re.fullmatch(told, playing.failure, re.DOTALL)
