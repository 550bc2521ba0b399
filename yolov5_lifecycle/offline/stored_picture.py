"""A picture that was stored somewhere."""

from __future__ import annotations

from typing import Protocol

from yolov5_lifecycle.images import Picture


class StoredPicture(Protocol):
    """One picture of a recording, a folder or a video, read when it is wanted."""

    @property
    def label(self) -> str:
        """What to call it in a message: a time stamp, a file, a frame."""

    def load(self) -> Picture:
        """The pixels; raises ImageError."""
