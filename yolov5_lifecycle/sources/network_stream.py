"""Network camera and GStreamer streams, with automatic reconnection."""

from __future__ import annotations

import re
import threading
from collections.abc import Callable, Iterator
from contextlib import suppress
from urllib.parse import urlsplit

import cv2
import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.printable import in_one_line
from yolov5_lifecycle.process.standard_streams import stderr_without_secrets
from yolov5_lifecycle.sources.frames import SourceError

SCHEMES = ("rtsp", "rtsps", "rtmp", "rtmps", "http", "https", "udp", "tcp", "rtp", "srt")
RETRY_S = 5.0
_TIMEOUT_MS = 10_000
"""For connecting and for each frame; OpenCV's default is 30 s. GStreamer pipelines set their own."""
_SCHEME = re.compile(r"([A-Za-z][A-Za-z0-9+.-]*)://")
_HINT = "Percent-encode what a password has of #, /, ? and blanks: %23, %2F, %3F and %20."

Report = Callable[[str], None]
Wait = Callable[[float], bool]
"""Waits the given seconds; True when interrupted because the stream is no longer needed."""
sleep: Wait = threading.Event().wait


def is_stream(source: str) -> bool:
    """Whether `source` is a URL or a GStreamer pipeline (elements separated by ` ! `)."""
    return _SCHEME.match(source) is not None or " ! " in source


def open_capture(source: str) -> cv2.VideoCapture:
    """OpenCV capture of a URL or pipeline, opened or not; SourceError when the backend is not built in."""
    scheme = _SCHEME.match(source)
    if scheme is None:
        check_backend(cv2.CAP_GSTREAMER, "GStreamer pipelines", "GStreamer")
        with stderr_without_secrets():
            return cv2.VideoCapture(source, cv2.CAP_GSTREAMER)
    if scheme[1].lower() not in SCHEMES:
        raise SourceError(
            f"'{in_one_line(source)}': expected a URL that begins with one of "
            f"{', '.join(SCHEMES)}, or the path of a file without file://."
        )
    if not _has_host(source):  # FFmpeg would take, and tell, a part of the password for the host
        raise SourceError(f"'{in_one_line(source)}': expected HOST or HOST:PORT before the path. {_HINT}")
    check_backend(cv2.CAP_FFMPEG, "URLs", "FFmpeg")
    timeouts = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, _TIMEOUT_MS, cv2.CAP_PROP_READ_TIMEOUT_MSEC, _TIMEOUT_MS]
    with stderr_without_secrets():
        return cv2.VideoCapture(source, cv2.CAP_FFMPEG, timeouts)


def _has_host(source: str) -> bool:
    try:
        address = urlsplit(source)
        return " " not in address.netloc and address.port != 0
    except ValueError:
        return False


def open_stream(
    source: str, *, reconnects: bool, report: Report, wait: Wait
) -> tuple[Iterator[NDArray[np.uint8]], float | None]:
    """BGR frames (H, W, 3) of `source` and, for a file served over the network, their rate, else None.

    With `reconnects`, a stream that ends is reconnected until it succeeds, which goes to `report`; `wait` is
    called before each attempt. Raises SourceError if the first connection fails.
    """
    first = open_capture(source)
    if not first.isOpened():
        first.release()
        raise SourceError(
            f"'{in_one_line(source)}' cannot be opened: is the address right, does the camera answer, and "
            f"does it need a user name and a password? {_HINT} OpenCV's own message is above."
        )
    is_file = first.get(cv2.CAP_PROP_FRAME_COUNT) > 0
    rate_hz = first.get(cv2.CAP_PROP_FPS)

    def frames() -> Iterator[NDArray[np.uint8]]:
        capture, shown = first, in_one_line(source)
        while True:
            with suppress(SourceError):
                yield from captured(capture)
            if not reconnects:
                return
            report(f"'{shown}' delivers no more images. Reconnecting every {RETRY_S:g} s.")
            while not capture.isOpened():
                if wait(RETRY_S):
                    return
                capture = open_capture(source)
            report(f"'{shown}' is connected again.")

    return frames(), rate_hz if is_file and 0 < rate_hz <= 1000 else None


def captured(capture: cv2.VideoCapture) -> Iterator[NDArray[np.uint8]]:
    """BGR frames (H, W, 3) to the end, where it is released; SourceError if one cannot be decoded."""
    try:
        while True:
            is_read, pixels = capture.read()
            if not is_read:
                return
            yield np.asarray(pixels, np.uint8)
    except cv2.error as error:
        raise SourceError(f"OpenCV cannot decode the next frame: {error.err}.") from None
    finally:
        capture.release()


def check_backend(backend: int, what: str, library: str) -> None:
    """Raise SourceError where OpenCV was built without `backend`, called `library`, which opens `what`."""
    if not cv2.videoio_registry.hasBackend(backend):
        raise SourceError(
            f"This OpenCV ({cv2.__version__}) was built without {library} and cannot open {what}. "
            'Use a build that has it: python3 -c "import cv2; print(cv2.getBuildInformation())" lists them '
            "under Video I/O."
        )
