"""Annotated images as a file."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.images.image import ColourImage

_TITLE_PX = 28
_GAP_PX = 8
_PAPER = 255
_INK = (40, 40, 40)


def saved(image: ColourImage, path: Path) -> Path:
    """Write `image` to `path`; raises OSError."""
    pixels = image.pixels if image.order == "bgr" else image.pixels[..., ::-1]
    if not cv2.imwrite(str(path), pixels, [cv2.IMWRITE_PNG_COMPRESSION, 9]):
        raise OSError(f"{path} cannot be written")
    return path


def side_by_side(images: Mapping[str, ColourImage]) -> ColourImage:
    """The images side by side, each below its name, on white."""
    titled = [_titled(name, image) for name, image in images.items()]
    height = max(pixels.shape[0] for pixels in titled)
    gap = np.full((height, _GAP_PX, 3), _PAPER, np.uint8)
    columns = [gap]
    for pixels in titled:
        below = height - pixels.shape[0]
        columns += [np.pad(pixels, ((0, below), (0, 0), (0, 0)), constant_values=_PAPER), gap]
    return ColourImage(np.hstack(columns[1:-1]), "bgr")


def _titled(name: str, image: ColourImage) -> NDArray[np.uint8]:
    pixels = image.pixels if image.order == "bgr" else image.pixels[..., ::-1]
    title = np.full((_TITLE_PX, pixels.shape[1], 3), _PAPER, np.uint8)
    cv2.putText(title, name, (2, _TITLE_PX - 9), cv2.FONT_HERSHEY_SIMPLEX, 0.6, _INK, 1, cv2.LINE_AA)
    return np.vstack((title, pixels))
