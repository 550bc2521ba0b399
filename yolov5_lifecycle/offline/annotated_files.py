"""Annotated pictures as files: one, a folder of them, or a video."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.image_encoding import encoded
from yolov5_lifecycle.images import Picture
from yolov5_lifecycle.offline.whole_output import OutputError

_CODECS = {".mp4": "mp4v", ".avi": "MJPG"}


def write_picture(path: Path, drawn: Picture) -> None:
    """Write one picture in the format that the name says; raises OutputError."""
    try:
        is_written = cv2.imwrite(str(path), encoded(drawn, "bgr8"))
    except cv2.error as error:
        raise OutputError(f"{path.name}: OpenCV cannot write this picture: {error.err}.") from None
    if not is_written:
        raise OutputError(f"{path.name}: this picture cannot be written; is the disk full?")


class VideoOutput:
    """Owns a video that is written frame by frame at `rate_hz`; all frames have the size of the first.

    Raises OutputError at birth for a format that is not known.
    """

    def __init__(self, path: Path, rate_hz: float) -> None:
        if path.suffix.lower() not in _CODECS:
            raise OutputError(f"{path.name}: expected a video that ends in {' or '.join(_CODECS)}.")
        self._path = path
        self._rate_hz = rate_hz
        self._writer: Any = None

    def add(self, drawn: Picture) -> None:
        """Raises OutputError when this OpenCV cannot write the format."""
        frame: NDArray[np.uint8] = encoded(drawn, "bgr8")
        if self._writer is None:
            self._writer = self._opened(drawn.size_hw)
        self._writer.write(np.ascontiguousarray(frame))

    def close(self) -> None:
        if self._writer is not None:
            self._writer.release()

    def _opened(self, size_hw: tuple[int, int]) -> Any:
        codec = cv2.VideoWriter.fourcc(*_CODECS[self._path.suffix.lower()])
        writer = cv2.VideoWriter(str(self._path), codec, self._rate_hz, size_hw[::-1])
        if not writer.isOpened():
            others = " or ".join(suffix for suffix in _CODECS if suffix != self._path.suffix.lower())
            raise OutputError(f"{self._path.name}: this OpenCV cannot write such a video; try {others}.")
        return writer
