"""The name of the coordinate frame in the header of an image or camera_info."""

from __future__ import annotations

from typing import Any

from yolov5_lifecycle.images.image import ImageError

MAX_FRAME_ID = 256
"""Characters. Each detection repeats the name, so a long one would multiply."""


def check_frame_id(message: Any) -> None:
    """Raise ImageError if the frame_id in the header of `message` has more than MAX_FRAME_ID characters."""
    length = len(message.header.frame_id)
    if length > MAX_FRAME_ID:
        raise ImageError(
            f"Expected a frame_id of at most {MAX_FRAME_ID} characters, found {length}. Correct it in the "
            "driver of the camera."
        )
