"""Network streams: which sources are streams, when they are reconnected, and how failures are reported."""

from __future__ import annotations

import socket
import threading
from collections.abc import Iterable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from itertools import islice
from typing import Any

import cv2
import numpy as np
import pytest

from yolov5_lifecycle.sources.frames import SourceError
from yolov5_lifecycle.sources.network_stream import (
    is_stream,
    open_capture,
    open_stream,
)
from yolov5_lifecycle.sources.source import open_source

URL = "rtsp://user:secret@camera/stream"


class FakeCapture:
    """A stream that gives `count` frames, numbered by the camera's `numbers`, or cannot be opened."""

    def __init__(self, numbers: Iterator[int], count: int | None, *, length: int = 0) -> None:
        self._numbers = numbers
        self._left = count or 0
        self._length = length
        self._is_opened = count is not None
        self.is_damaged = False

    def isOpened(self) -> bool:  # noqa: N802 - OpenCV's name
        return self._is_opened

    def read(self) -> tuple[bool, Any]:
        if self._left == 0:
            if self.is_damaged:
                cv2.resize(np.empty((0, 0)), (1, 1))  # raises
            return False, None
        self._left -= 1
        return True, np.full((2, 3, 3), next(self._numbers), np.uint8)

    def get(self, property_id: int) -> float:
        return {cv2.CAP_PROP_FRAME_COUNT: self._length, cv2.CAP_PROP_FPS: 25.0}[property_id]

    def release(self) -> None:
        self._is_opened = False


class Camera:
    """Connections one after the other: each has a number of frames, None refuses. Notes waits and reports."""

    def __init__(self, counts: Iterable[int | None], *, length: int = 0, max_waits: int = 100) -> None:
        numbers = iter(range(256))
        self.captures = [FakeCapture(numbers, count, length=length) for count in counts]
        self.waits_s: list[float] = []
        self.reports: list[str] = []
        self._next = iter(self.captures)
        self._max_waits = max_waits

    def connect(self, _: str) -> Any:
        return next(self._next)

    def wait(self, seconds: float) -> bool:
        self.waits_s.append(seconds)
        return len(self.waits_s) > self._max_waits

    def numbers(self, count: int, *, reconnects: bool = True) -> list[int]:
        frames, _ = open_stream(
            URL, reconnects=reconnects, report=self.reports.append, wait=self.wait, connect=self.connect
        )
        return [int(pixels[0, 0, 0]) for pixels in islice(frames, count)]


def test_a_stream_that_breaks_off_is_connected_again() -> None:
    camera = Camera([2, 3])
    assert camera.numbers(5) == [0, 1, 2, 3, 4]
    assert camera.waits_s == [5.0]
    assert camera.reports == [
        "'rtsp://***@camera/stream' delivers no more images. Reconnecting every 5 s.",
        "'rtsp://***@camera/stream' is connected again.",
    ]
    assert not camera.captures[0].isOpened()


def test_a_stream_is_connected_again_after_an_image_that_cannot_be_decoded() -> None:
    camera = Camera([2, 3])
    camera.captures[0].is_damaged = True
    assert camera.numbers(5) == [0, 1, 2, 3, 4]
    assert not camera.captures[0].isOpened()


def test_a_stream_is_tried_until_images_come_again_which_is_told_once() -> None:
    camera = Camera([1, None, None, 0, None, 1])
    assert camera.numbers(2) == [0, 1]
    assert camera.waits_s == [5.0] * 5
    assert [report.rpartition("'")[2][:9] for report in camera.reports] == [" delivers", " is conne"] * 2


def test_the_end_of_the_process_ends_the_wait() -> None:
    camera = Camera([1, None, None], max_waits=2)
    assert camera.numbers(9) == [0]
    assert len(camera.waits_s) == 3


def test_a_stream_that_is_played_once_ends() -> None:
    camera = Camera([2])
    assert camera.numbers(9, reconnects=False) == [0, 1]
    assert camera.waits_s == []


@pytest.mark.parametrize(("length", "rate_hz"), [(0, None), (100, 25.0)], ids=["camera", "file"])
def test_only_a_file_that_is_served_has_a_rate(length: int, rate_hz: float | None) -> None:
    camera = Camera([1], length=length)
    _, found_hz = open_stream(URL, reconnects=True, report=camera.reports.append, connect=camera.connect)
    assert found_hz == rate_hz


@pytest.mark.parametrize(
    ("source", "expected"),
    [
        pytest.param("rtsp://host/x", True, id="URL"),
        pytest.param("videotestsrc ! appsink", True, id="pipeline"),
        pytest.param("wow!.mp4", False, id="exclamation mark"),
        pytest.param("0", False, id="device"),
    ],
)
def test_a_stream_is_recognized(source: str, expected: bool) -> None:
    assert is_stream(source) is expected


def test_a_refused_connection_is_an_error_that_says_what_to_check() -> None:
    with socket.socket() as server:
        server.bind(("127.0.0.1", 0))  # bound and not listening: nobody else can answer there
        port = server.getsockname()[1]
        with pytest.raises(SourceError, match="cannot be opened: is the address right"):
            open_source(f"rtsp://127.0.0.1:{port}/stream")


class MjpegHandler(BaseHTTPRequestHandler):
    """Sends three images as a network camera does, then closes the connection."""

    def do_GET(self) -> None:
        self.send_response(200)
        self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=frame")
        self.end_headers()
        _, jpeg = cv2.imencode(".jpg", np.full((48, 64, 3), 90, np.uint8))
        part = b"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: %d\r\n\r\n%b\r\n"
        for _ in range(3):
            self.wfile.write(part % (jpeg.size, jpeg.tobytes()))

    def log_message(self, *_: object) -> None:
        pass


@pytest.mark.skipif(not cv2.videoio_registry.hasBackend(cv2.CAP_FFMPEG), reason="OpenCV without FFmpeg")
def test_a_camera_that_closes_the_connection_is_connected_again() -> None:
    reports: list[str] = []
    with ThreadingHTTPServer(("127.0.0.1", 0), MjpegHandler) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        url = f"http://user:secret@127.0.0.1:{server.server_port}/camera.mjpg"
        source = open_source(url, size_hw=(24, 32), report=reports.append, wait=lambda _: False)
        frames = list(islice(source.frames, 7))
        server.shutdown()
        thread.join()
    assert {frame.image.size_hw for frame in frames} == {(24, 32)}
    assert source.rate_hz is None
    assert sum("is connected again" in report for report in reports) >= 2
    assert not any("secret" in report for report in reports)


def test_an_unknown_scheme_is_refused() -> None:
    with pytest.raises(SourceError, match="expected a URL that begins with one of rtsp,"):
        open_source("file:///etc/passwd")


@pytest.mark.skipif(
    cv2.videoio_registry.hasBackend(cv2.CAP_GSTREAMER), reason="this OpenCV was built with GStreamer"
)
def test_a_build_without_gstreamer_says_so() -> None:
    with pytest.raises(SourceError, match="built without GStreamer and cannot open GStreamer pipelines"):
        open_capture("videotestsrc ! appsink")
