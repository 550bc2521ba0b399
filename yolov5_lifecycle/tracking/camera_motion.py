"""How a camera moved between two images, from the images: sparse optical flow of a reduced copy.

Corners outside the detected boxes are followed (Lucas and Kanade, with pyramids), and the similarity that
most of them agree on is the motion of the camera, as in BoT-SORT (Aharon et al. 2022).
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.images.image import ColourImage
from yolov5_lifecycle.tracking.motion import Similarity

MAX_REDUCED_SIDE_PX = 192
"""Longer side of the copy in which corners are followed; bounds the time for an image of any size."""
MIN_CORNERS = 8
"""Corners that must agree; with fewer the motion is unknown."""
MIN_SHARE = 0.35
"""Of the corners that were found again; the others may be on things that move."""
STILL_PX = 0.15
"""A smaller motion of most corners is an error of the flow."""
_MARGIN = 0.1  # of a box, to each side, in which no corners are chosen
_BOXES = 100  # that are left out, those of the highest scores
_AGREEMENT_PX = 0.7
_SCALES = (0.6, 1.6)  # between two images; a larger zoom is no motion of a camera
_FLOW = {"winSize": (13, 13), "maxLevel": 3, "criteria": (3, 8, 0.03), "minEigThreshold": 1e-3}
_CORNERS = {"maxCorners": 80, "qualityLevel": 0.01, "minDistance": 7, "blockSize": 3}

Points = NDArray[np.float32]
Grey = NDArray[np.uint8]


class CameraMotion:
    """The motion of one camera from image to image."""

    def __init__(self) -> None:
        self._grey: Grey | None = None
        self._corners: Points = _NO_CORNERS

    def reset(self) -> None:
        """Forget the last image. Idempotent."""
        self._grey, self._corners = None, _NO_CORNERS

    def since_last(self, image: ColourImage, boxes_xyxy: NDArray[np.floating]) -> Similarity | None:
        """(2, 3) map from pixels of the last image to those of `image`; None if it is still or unknown.

        `boxes_xyxy` (n, 4) of the objects in `image`, which may move by themselves.
        """
        grey, factors_xy = _reduced(image)
        similarity = None
        if self._grey is not None and self._grey.shape == grey.shape:
            similarity = _similarity(self._grey, grey, self._corners)
        self._grey, self._corners = grey, _corners(grey, boxes_xyxy[:_BOXES] * np.tile(factors_xy, 2))
        if similarity is None:
            return None
        linear = similarity[:, :2] * factors_xy / factors_xy[:, None]
        return np.column_stack((linear, similarity[:, 2] / factors_xy))


_NO_CORNERS: Points = np.zeros((0, 1, 2), np.float32)


def _reduced(image: ColourImage) -> tuple[Grey, NDArray[np.float64]]:
    """A grey copy (h, w), and its pixels per pixel of the image in x and y.

    Rows and columns of a large image are skipped before it is resized, so that the time has a bound.
    """
    pixels, _ = image.as_sent
    height, width = pixels.shape[:2]
    scale = min(MAX_REDUCED_SIDE_PX / max(height, width), 1.0)
    size = max(round(width * scale), 1), max(round(height * scale), 1)
    columns, rows = (
        max(2 * side // (3 * reduced), 1) for side, reduced in zip((width, height), size, strict=True)
    )
    green = pixels[rows // 2 :: rows, columns // 2 :: columns]
    green = np.ascontiguousarray(green if green.ndim == 2 else green[..., 1])
    grey = np.asarray(cv2.resize(green, size, interpolation=cv2.INTER_AREA), np.uint8)
    return grey, np.array((size[0] / width, size[1] / height))


def _corners(grey: Grey, boxes_xyxy: NDArray[np.floating]) -> Points:
    """Corners (k, 1, 2) of `grey` outside the boxes."""
    mask = np.full(grey.shape, 255, np.uint8)
    margin = (boxes_xyxy[:, 2:] - boxes_xyxy[:, :2]) * _MARGIN + 1
    grown = np.concatenate((boxes_xyxy[:, :2] - margin, boxes_xyxy[:, 2:] + margin), axis=1)
    bounds = np.clip(np.nan_to_num(grown), 0, max(grey.shape)).astype(int)
    for left, top, right, bottom in bounds.tolist():
        mask[top:bottom, left:right] = 0
    found = cv2.goodFeaturesToTrack(grey, mask=mask, **_CORNERS)
    return _NO_CORNERS if found is None else np.asarray(found, np.float32)


def _similarity(before: Grey, grey: Grey, corners: Points) -> Similarity | None:
    """(2, 3) map from pixels of `before` to those of `grey`; None if they do not move or do not agree."""
    if len(corners) < MIN_CORNERS:
        return None
    moved, status, _ = cv2.calcOpticalFlowPyrLK(before, grey, corners, None, **_FLOW)
    is_found = status.ravel() == 1
    if is_found.sum() < MIN_CORNERS:
        return None
    motions_px = np.linalg.norm((moved - corners)[is_found], axis=-1)
    if np.median(motions_px) < STILL_PX:
        return None
    matrix, agree = cv2.estimateAffinePartial2D(
        corners[is_found], moved[is_found], ransacReprojThreshold=_AGREEMENT_PX, maxIters=200
    )
    if matrix is None or agree.sum() < max(MIN_CORNERS, MIN_SHARE * is_found.sum()):
        return None
    scale = float(np.hypot(*matrix[:, 0]))
    return matrix if np.isfinite(matrix).all() and _SCALES[0] <= scale <= _SCALES[1] else None
