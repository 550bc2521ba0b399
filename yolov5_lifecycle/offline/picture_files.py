"""Image sources: a file, a folder of files, or a video."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2

from yolov5_lifecycle.images.image import ImageError, Picture
from yolov5_lifecycle.sources.frames import SourceError
from yolov5_lifecycle.sources.source import (
    PICTURE_RATE_HZ,
    PICTURE_SUFFIXES,
    open_source,
    picture_paths,
)


@dataclass(frozen=True)
class PictureFile:
    """An image file."""

    path: Path

    @property
    def label(self) -> str:
        return str(self.path)

    @property
    def identity(self) -> dict[str, str | int]:
        """The keys that identify it in a line of JSON."""
        return {"file": str(self.path)}

    def load(self) -> Picture:
        try:
            # An absolute path is never mistaken for a camera index.
            return next(open_source(str(self.path.absolute()), loop=False).frames).picture
        except SourceError as error:
            raise ImageError(str(error)) from None


@dataclass(frozen=True)
class VideoFrame:
    """A video frame, counted from 0."""

    number: int
    picture: Picture

    @property
    def label(self) -> str:
        return f"frame {self.number}"

    @property
    def identity(self) -> dict[str, str | int]:
        """The keys that identify it in a line of JSON."""
        return {"frame": self.number}

    def load(self) -> Picture:
        return self.picture


def is_picture(path: Path) -> bool:
    """Whether `path` has an image file extension; any other file may be a video."""
    return path.suffix.lower() in PICTURE_SUFFIXES


def picture_files(path: Path) -> list[PictureFile]:
    """The image `path`, or the images in the folder `path`; raises SourceError for a folder without any."""
    return [PictureFile(file) for file in picture_paths(path)]


@dataclass(frozen=True)
class VideoFile:
    """A video: its frames, its rate, and the number of frames it claims to have, 0 if unknown."""

    frames: Iterator[VideoFrame]
    rate_hz: float
    claimed_frames: int

    @classmethod
    def open(cls, path: Path) -> VideoFile:
        """Open the video at `path`; raises SourceError if it is not a video."""
        if not path.is_file():
            raise SourceError(f"{path} is not a regular file: detect_bag reads videos from files only.")
        source = open_source(str(path.absolute()), loop=False)
        capture = cv2.VideoCapture(str(path))
        claimed_frames = max(int(capture.get(cv2.CAP_PROP_FRAME_COUNT)), 0)
        capture.release()
        frames = (VideoFrame(number, frame.picture) for number, frame in enumerate(source.frames))
        return cls(frames, source.rate_hz or PICTURE_RATE_HZ, claimed_frames)
