"""Network streams: which sources are streams, when they are reconnected, and how failures are reported."""

from __future__ import annotations

import re
import socket
from dataclasses import dataclass
from itertools import count, islice
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from support.file_server import FileServer, ServedRequest, sending_ranges
from support.grey_images import grey_video

from yolov5_lifecycle.sources.frames import SourceError
from yolov5_lifecycle.sources.network_stream import RETRY_S, is_stream, open_capture
from yolov5_lifecycle.sources.source import open_source

FFMPEG = pytest.mark.skipif(
    not cv2.videoio_registry.hasBackend(cv2.CAP_FFMPEG), reason="OpenCV without FFmpeg"
)


class Camera:
    """A network camera: its connections have these numbers of images, each lighter; None is refused.

    After the last connection it answers no more.
    """

    def __init__(self, *counts: int | None) -> None:
        self._counts = iter(counts)
        self._numbers = count()

    def __call__(self, request: ServedRequest) -> None:
        if (images := next(self._counts, None)) is None:
            request.answer(b"", status=404)
            return
        request.send_response(200)
        request.send_header("Content-Type", "multipart/x-mixed-replace; boundary=frame")
        request.end_headers()
        for number in islice(self._numbers, images):
            _, jpeg = cv2.imencode(".jpg", np.full((48, 64, 3), 20 * number, np.uint8))
            part = b"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: %d\r\n\r\n%b\r\n"
            request.wfile.write(part % (jpeg.size, jpeg.tobytes()))


@dataclass
class Watched:
    """What was received of a camera: the numbers of the images, the waits and what was reported."""

    numbers: list[int]
    waits_s: list[float]
    reports: list[str]


def watched(camera: Camera, *, reconnects: bool = True, most_waits: int = 5) -> Watched:
    """All that `camera` sends, until it was waited for one time more than `most_waits`."""
    waits_s, reports = list[float](), list[str]()

    def wait(seconds: float) -> bool:
        waits_s.append(seconds)
        return len(waits_s) > most_waits

    with FileServer(camera) as server:
        url = f"http://user:secret@127.0.0.1:{server.server_port}/camera.mjpg"
        source = open_source(url, size_hw=(24, 32), loop=reconnects, report=reports.append, wait=wait)
        images = [frame.image for frame in source.frames]
    assert source.rate_hz is None
    assert {image.size_hw for image in images} == {(24, 32)}
    return Watched([round(image.pixels.mean() / 20) for image in images], waits_s, reports)


@FFMPEG
def test_a_stream_that_breaks_off_is_tried_until_images_come_again_which_is_told_once() -> None:
    found = watched(Camera(3, None, None, 0, 4))
    assert found.numbers == [*range(7)]
    assert found.waits_s == [RETRY_S] * 6
    told = [re.sub(r"^'http://\*\*\*@127.0.0.1:\d+/camera.mjpg' ", "", report) for report in found.reports]
    lost = "delivers no more images. Reconnecting every 5 s."
    assert told == [lost, "is connected again.", lost]


@FFMPEG
def test_a_stream_is_connected_again_after_an_image_that_cannot_be_decoded(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    captures: list[Any] = []
    capture = cv2.VideoCapture

    class FirstIsDamaged:
        def __init__(self, *arguments: Any) -> None:
            self._capture = capture(*arguments)
            captures.append(self)

        def __getattr__(self, name: str) -> Any:
            return getattr(self._capture, name)

        def read(self) -> Any:
            if self is captures[0]:
                cv2.resize(np.empty((0, 0)), (1, 1))  # raises
            return self._capture.read()

    monkeypatch.setattr(cv2, "VideoCapture", FirstIsDamaged)
    assert watched(Camera(3, 3), most_waits=1).numbers == [3, 4, 5]
    assert not any(capture.isOpened() for capture in captures)


@FFMPEG
def test_a_stream_that_is_played_once_ends() -> None:
    assert watched(Camera(3, 3), reconnects=False) == Watched([0, 1, 2], [], [])


@FFMPEG
def test_a_video_that_is_served_has_a_rate(tmp_path: Path) -> None:
    with FileServer(sending_ranges(grey_video(tmp_path / "video.avi").read_bytes())) as server:
        assert open_source(f"{server.address}/video.avi").rate_hz == 10.0


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
        told = r"^'rtsp://\*\*\*@h/x' cannot be opened: is the address right, .* Percent-encode what"
        with pytest.raises(SourceError, match=told):  # the port may be the beginning of a password
            open_source(f"rtsp://127.0.0.1:{port}/secret@h/x")


def test_an_unknown_scheme_is_refused() -> None:
    with pytest.raises(SourceError, match="expected a URL that begins with one of rtsp,"):
        open_source("file:///etc/passwd")


@pytest.mark.skipif(
    cv2.videoio_registry.hasBackend(cv2.CAP_GSTREAMER), reason="this OpenCV was built with GStreamer"
)
def test_a_build_without_gstreamer_says_so() -> None:
    with pytest.raises(SourceError, match="built without GStreamer and cannot open GStreamer pipelines"):
        open_capture("videotestsrc ! appsink")
