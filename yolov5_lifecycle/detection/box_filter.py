"""Which boxes count: those in certain regions of the image and of certain sizes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.images.region import Region

Anchor = Literal["center", "foot"]


@dataclass(frozen=True, kw_only=True)
class BoxFilter:
    """The settings of the same names; with their defaults every box counts."""

    regions: tuple[Region, ...] = ()
    """A box counts only if its anchor is in one of them; without any, everywhere."""
    ignore_regions: tuple[Region, ...] = ()
    """A box does not count if its anchor is in one of them."""
    region_anchor: Anchor = "center"
    """Which point of a box must be in a region: its centre, or the middle of its lower side."""
    min_box_size: float = 0.0
    """Minimum longer side of a box: up to 1 a fraction of the image's longer side, above 1 pixels."""
    max_box_size: float = 0.0
    """Maximum longer side, in the same units; 0 for none."""

    def admits(self, boxes_xyxy: NDArray[np.float32], size_hw: tuple[int, int]) -> NDArray[np.bool_]:
        """Which of the boxes (n, 4), in pixels of an image of `size_hw`, count."""
        counts = np.ones(len(boxes_xyxy), np.bool_)
        longer_px = (boxes_xyxy[:, 2:] - boxes_xyxy[:, :2]).max(axis=1)
        if self.min_box_size:
            counts &= longer_px >= _pixels(self.min_box_size, size_hw)
        if self.max_box_size:
            counts &= longer_px <= _pixels(self.max_box_size, size_hw)
        anchors_xy = self._anchors_xy(boxes_xyxy) / (size_hw[1], size_hw[0])
        if self.regions:
            counts &= np.any([region.contains(anchors_xy) for region in self.regions], axis=0)
        for region in self.ignore_regions:
            counts &= ~region.contains(anchors_xy)
        return counts

    def _anchors_xy(self, boxes_xyxy: NDArray[np.float32]) -> NDArray[np.float64]:
        """The anchors (n, 2) in pixels."""
        boxes = boxes_xyxy.astype(np.float64)
        centres_xy = (boxes[:, :2] + boxes[:, 2:]) / 2
        if self.region_anchor == "foot":
            centres_xy[:, 1] = boxes[:, 3]
        return centres_xy


def _pixels(size: float, size_hw: tuple[int, int]) -> np.float32:
    """A size as a number of pixels."""
    return np.float32(size if size > 1 else size * max(size_hw))
