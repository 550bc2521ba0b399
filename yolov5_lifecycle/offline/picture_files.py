"""Pictures in files: one, a folder of them, or a video."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2

from yolov5_lifecycle.images import ImageError, Picture
from yolov5_lifecycle.picture_source import SourceError, open_source

_PICTURE_SUFFIXES = (".jpg", ".jpeg", ".png", ".bmp", ".webp", ".tif", ".tiff")
_USUAL_RATE_HZ = 30.0


@dataclass(frozen=True)
class PictureFile:
    """A file with one picture."""

    path: Path

    @property
    def label(self) -> str:
        return str(self.path)

    @property
    def identity(self) -> dict[str, str | int]:
        """What names it in a line of JSON."""
        return {"file": str(self.path)}

    def load(self) -> Picture:
        try:
            # As an absolute path it is never taken for the number of a camera.
            return next(open_source(str(self.path.absolute()), loop=False)).picture
        except SourceError as error:
            raise ImageError(str(error)) from None


@dataclass(frozen=True)
class VideoFrame:
    """A frame of a video, counted from 0."""

    number: int
    picture: Picture

    @property
    def label(self) -> str:
        return f"frame {self.number}"

    @property
    def identity(self) -> dict[str, str | int]:
        """What names it in a line of JSON."""
        return {"frame": self.number}

    def load(self) -> Picture:
        return self.picture


def is_picture(path: Path) -> bool:
    """Whether `path` has the name of a picture; any other file may be a video."""
    return path.suffix.lower() in _PICTURE_SUFFIXES


def picture_files(path: Path) -> list[PictureFile]:
    """The picture `path`, or those that lie in it, by name; raises SourceError for a folder without any."""
    if not path.is_dir():
        return [PictureFile(path)]
    files = [PictureFile(file) for file in sorted(path.iterdir()) if is_picture(file)]
    if not files:
        raise SourceError(f"The folder {path} has no pictures ({', '.join(_PICTURE_SUFFIXES)}).")
    return files


@dataclass(frozen=True)
class VideoFile:
    """A video: its rate, and how many frames it claims to have, 0 when it does not say."""

    path: Path
    rate_hz: float
    claimed_frames: int

    @classmethod
    def look(cls, path: Path) -> VideoFile:
        capture = cv2.VideoCapture(str(path))
        rate_hz, frames = capture.get(cv2.CAP_PROP_FPS), capture.get(cv2.CAP_PROP_FRAME_COUNT)
        capture.release()
        return cls(path, rate_hz if 0 < rate_hz < 1000 else _USUAL_RATE_HZ, max(int(frames), 0))

    def frames(self) -> Iterator[VideoFrame]:
        """Every frame; raises SourceError when the file is no video."""
        frames = open_source(str(self.path.absolute()), loop=False)
        return (VideoFrame(number, frame.picture) for number, frame in enumerate(frames))
