"""What an image source delivers: frames at a rate, or an error."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from yolov5_lifecycle.images.image import ColourImage
from yolov5_lifecycle.sources.scene import Shape
from yolov5_lifecycle.sources.scene_depth import DepthFrame


class SourceError(ValueError):
    """A source that is missing, unreadable or lost; the message says which and what to do."""


@dataclass(frozen=True)
class SourceFrame:
    """One image and, for the synthetic scene only, its shapes and, on request, its depth."""

    image: ColourImage
    shapes: Sequence[Shape] = ()
    depth: DepthFrame | None = None


@dataclass(frozen=True)
class ImageSource:
    """Frames and their nominal rate.

    `rate_hz` is None for a device, which delivers frames at its own pace.
    """

    frames: Iterator[SourceFrame]
    rate_hz: float | None
    claimed_frames: int = 0
    """What a video says of itself; 0 if unknown."""
