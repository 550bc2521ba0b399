"""Image sources: a file, a folder of files, or a video."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from yolov5_lifecycle.images.image import ColourImage, ImageError
from yolov5_lifecycle.sources.frames import SourceError
from yolov5_lifecycle.sources.source import (
    IMAGE_RATE_HZ,
    IMAGE_SUFFIXES,
    image_paths,
    open_source,
    read_image,
)


@dataclass(frozen=True)
class ImageFile:
    """An image file."""

    path: Path

    @property
    def label(self) -> str:
        return str(self.path)

    @property
    def identity(self) -> dict[str, str | int]:
        """The key that identifies it in its source, and the value."""
        return {"file": str(self.path)}

    @property
    def stem(self) -> str:
        """Its name without the suffix."""
        return self.path.stem

    @property
    def stamp_s(self) -> None:
        """None: the time between the files of a folder is unknown, so they are not tracked."""

    def load(self) -> ColourImage:
        if not os.path.lexists(self.path):
            raise ImageError("file not found")
        try:
            return read_image(self.path)
        except SourceError as error:
            raise ImageError(str(error)) from None


@dataclass(frozen=True)
class VideoFrame:
    """A video frame, counted from 0, and its time in the video."""

    number: int
    stamp_s: float
    image: ColourImage

    @property
    def label(self) -> str:
        return f"frame {self.number}"

    @property
    def identity(self) -> dict[str, str | int]:
        """The key that identifies it in its source, and the value."""
        return {"frame": self.number}

    @property
    def stem(self) -> str:
        """The name of files about it."""
        return f"frame_{self.number:06}"

    def load(self) -> ColourImage:
        return self.image


def is_image(path: Path) -> bool:
    """Whether `path` has an image file extension; any other file may be a video."""
    return path.suffix.lower() in IMAGE_SUFFIXES


def has_still_images(path: Path) -> bool:
    """Whether `path` is an image file or a folder of them."""
    return path.is_dir() or is_image(path)


def image_files(path: Path) -> list[ImageFile]:
    """The image `path`, or the images in the folder `path`; raises SourceError for a folder without any."""
    return list(map(ImageFile, image_paths(path)))


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
        rate_hz = source.rate_hz or IMAGE_RATE_HZ
        frames = (
            VideoFrame(number, number / rate_hz, frame.image) for number, frame in enumerate(source.frames)
        )
        return cls(frames, rate_hz, source.claimed_frames)
