"""Evenly grey images, as a folder of files and as a video."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from yolov5_lifecycle.images.image import ColourImage

GREYS = (10, 90, 170, 250)


def grey_folder(folder: Path) -> Path:
    """Images, 24 x 32, numbered in the order of GREYS, and a file of another kind, in `folder`."""
    for number, grey in enumerate(GREYS, start=8):
        assert cv2.imwrite(str(folder / f"{number}.png"), np.full((24, 32, 3), grey, np.uint8))
    (folder / "notes.txt").write_text("not an image")
    return folder


def grey_video(path: Path) -> Path:
    """The same images as a video of 10 frames per second."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, (32, 24))
    assert writer.isOpened()
    for grey in GREYS:
        writer.write(np.full((24, 32, 3), grey, np.uint8))
    writer.release()
    return path


def nearest_grey(image: ColourImage) -> int:
    """The one of GREYS that is nearest to its brightness."""
    return min(GREYS, key=lambda grey: abs(grey - image.pixels.mean()))
