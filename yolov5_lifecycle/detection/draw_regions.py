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
"""Share that is left of the pixels in a region that is ignored."""

_WHITE, _BLACK = 255, 0
_SUBPIXEL_BITS = 4


def draw_regions(canvas: NDArray[np.uint8], box_filter: BoxFilter, *, line_px: int) -> None:
    """Outline the regions on `canvas` (H, W, 3); darken and hatch those that are ignored.

    A line is a blend of white, with a blend of black on both sides, so that it is visible on any image.
    """
    if not (box_filter.regions or box_filter.ignore_regions):
        return
    ignored = _corners(box_filter.ignore_regions, canvas.shape)
    outlines = [*_corners(box_filter.regions, canvas.shape), *ignored]
    covered = np.zeros(canvas.shape[:2], np.uint8)
    if ignored:
        for corners in ignored:  # one by one: of two in one call, the part that both cover would stay
            cv2.fillPoly(covered, [corners], 255, shift=_SUBPIXEL_BITS)
        cv2.copyTo(cv2.convertScaleAbs(canvas, alpha=IGNORED_BRIGHTNESS), covered, canvas)
    lines = _hatching(canvas.shape, 16 * line_px, line_px) & covered
    for thickness, shade in ((3 * line_px, _BLACK), (line_px, _WHITE)):
        mask = lines.copy() if shade == _WHITE else np.zeros_like(covered)
        cv2.polylines(mask, outlines, True, 255, thickness, cv2.LINE_AA, _SUBPIXEL_BITS)
        _blend(canvas, mask, shade)


def _corners(regions: Sequence[Region], shape: tuple[int, ...]) -> list[NDArray[np.int32]]:
    """The corners of each region, (n, 1, 2), in fractions of pixels as OpenCV takes them."""
    scale = (np.array((shape[1], shape[0])) - 1) * 2**_SUBPIXEL_BITS
    return [np.rint(np.array(region.points_xy) * scale).astype(np.int32)[:, None] for region in regions]


def _hatching(shape: tuple[int, ...], step_px: int, line_px: int) -> NDArray[np.uint8]:
    """A mask (H, W) of diagonal lines."""
    rows, columns = np.ogrid[: shape[0], : shape[1]]
    return np.where((rows + columns) % step_px < line_px, 255, 0).astype(np.uint8)


def _blend(canvas: NDArray[np.uint8], mask: NDArray[np.uint8], shade: int) -> None:
    """Blend the pixels of `canvas` with a shade of grey where `mask` is 255, less where it is lower."""
    rows, columns = np.nonzero(mask)
    share = mask[rows, columns, None].astype(np.float32) * (LINE_OPACITY / 255)
    pixels = canvas[rows, columns].astype(np.float32)
    canvas[rows, columns] = np.rint(pixels + (shade - pixels) * share).astype(np.uint8)
