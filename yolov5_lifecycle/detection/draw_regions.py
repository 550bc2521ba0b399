"""Drawing of the regions in which detections count, and of those in which they do not."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.detection.box_filter import BoxFilter
from yolov5_lifecycle.images.region import Region

LINE_OPACITY = 0.5
"""Share of white in the pixels of a line, from 0 to 1."""
IGNORED_BRIGHTNESS = 0.6
"""Share of its brightness that a pixel keeps in an ignored region."""

_WHITE, _BLACK = 255, 0
_SUBPIXEL_BITS = 4
_HATCHING_STEP = 16
"""Distance between two lines, in line widths."""


def draw_regions(canvas: NDArray[np.uint8], box_filter: BoxFilter, *, line_px: int) -> None:
    """Outline the regions on `canvas` (H, W, 3); darken and hatch those that are ignored.

    The rows of `canvas` must follow each other in memory. A line is a blend of white, with a blend of black
    on both sides, so that it is visible on any image.
    """
    if not (box_filter.regions or box_filter.ignore_regions):
        return
    size_hw = (canvas.shape[0], canvas.shape[1])
    ignored = _corners(box_filter.ignore_regions, size_hw)
    outlines = [*_corners(box_filter.regions, size_hw), *ignored]
    covered = np.zeros(size_hw, np.uint8)
    if ignored:
        for corners in ignored:  # one by one: a single call leaves out where two overlap
            cv2.fillPoly(covered, [corners], 255, shift=_SUBPIXEL_BITS)
        cv2.copyTo(cv2.convertScaleAbs(canvas, alpha=IGNORED_BRIGHTNESS), covered, canvas)
    shades = {_BLACK: np.zeros(size_hw, np.uint8), _WHITE: _hatching(covered, line_px)}
    for (shade, mask), thickness in zip(shades.items(), (3 * line_px, line_px), strict=True):
        cv2.polylines(mask, outlines, True, 255, thickness, cv2.LINE_AA, _SUBPIXEL_BITS)
        _blend(canvas, mask, shade)


def _corners(regions: Sequence[Region], size_hw: tuple[int, int]) -> list[NDArray[np.int32]]:
    """The corners of each region, (n, 1, 2), in fractions of pixels as OpenCV takes them."""
    scale = (np.array(size_hw[::-1]) - 1) * 2**_SUBPIXEL_BITS
    return [np.rint(np.array(region.points_xy) * scale).astype(np.int32)[:, None] for region in regions]


def _hatching(covered: NDArray[np.uint8], line_px: int) -> NDArray[np.uint8]:
    """A mask (H, W) of diagonal lines where `covered` is not 0."""
    lines = np.zeros_like(covered)
    if not covered.any():
        return lines
    height, width = covered.shape
    for start in range(0, height + width, _HATCHING_STEP * line_px):
        cv2.line(lines, (start, 0), (start - height, height), 255, max(line_px // 2, 1))
    return np.asarray(cv2.bitwise_and(lines, covered), np.uint8)


def _blend(canvas: NDArray[np.uint8], mask: NDArray[np.uint8], shade: int) -> None:
    """Blend the pixels of `canvas` with a shade of grey where `mask` is 255, less where it is lower."""
    places = np.flatnonzero(mask > 0)
    shares = mask.reshape(-1)[places, None] * np.float32(LINE_OPACITY / 255)
    pixels = canvas.reshape(-1, 3)
    chosen = pixels[places].astype(np.float32)
    pixels[places] = (chosen + (shade - chosen) * shares + np.float32(0.5)).astype(np.uint8)
