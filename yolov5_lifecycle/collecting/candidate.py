"""A frame that may be kept."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.collecting.pace import Pace
from yolov5_lifecycle.collecting.reason import Reason, Why
from yolov5_lifecycle.collecting.rules import CollectRules
from yolov5_lifecycle.collecting.shades import Shades, shades_of
from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.images.image import ColourImage
from yolov5_lifecycle.images.region import Region

_SUBPIXEL_BITS = 4


@dataclass(frozen=True)
class Origin:
    """Where and when an image was taken: frame_id and stamp of its message."""

    frame_id: str
    sec: int
    nanosec: int


@dataclass(frozen=True, eq=False)
class Candidate:
    """A frame with what was found in it, on its way to the thread that decides and writes.

    The thread that offers it changes nothing in it afterwards.
    """

    image: ColourImage
    jpeg: NDArray[np.uint8] | None
    """(N,) the image as it was received, if that was a JPEG file."""
    detections: Detections
    """Those that are published, with masks if the model segments."""
    embedding: NDArray[np.float32]
    """(C,) see `Detections.embedding`."""
    origin: Origin
    reasons: Mapping[Reason, Why]
    """Why it is worth keeping. May be empty: it may still be novel."""
    rules: CollectRules
    pace: Pace

    @property
    def is_requested(self) -> bool:
        return Reason.REQUESTED in self.reasons

    @cached_property
    def visible_image(self) -> ColourImage:
        """The image without what must not be stored."""
        regions = self.rules.blank_regions
        return _blanked(self.image, regions) if regions else self.image

    @cached_property
    def shades(self) -> Shades:
        """Of `visible_image`."""
        return shades_of(self.visible_image)

    @property
    def held_bytes(self) -> int:
        """Memory that it holds while it waits."""
        return self.image.pixels.nbytes + (0 if self.jpeg is None else self.jpeg.nbytes)


def _blanked(image: ColourImage, regions: tuple[Region, ...]) -> ColourImage:
    """A copy of `image` whose `regions` are black."""
    pixels = np.ascontiguousarray(image.pixels).copy()
    height, width = image.size_hw
    for region in regions:
        corners = np.array(region.points_xy) * (width, height) * (1 << _SUBPIXEL_BITS)
        cv2.fillPoly(pixels, [np.rint(corners).astype(np.int32)], (0, 0, 0), shift=_SUBPIXEL_BITS)
    return ColourImage(pixels, image.order)
