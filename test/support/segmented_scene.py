"""A scripted model that segments, its scene of a cat in front of a dog, and who receives the masks."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import Image
from vision_msgs.msg import Detection2DArray

from support.camera_client import CameraClient, Viewer
from support.preparations import Preparations

SIZE_HW = (96, 128)
PARAMETERS = ("image_size:=128",)
"""With these the network input is the image."""
CAT_XYXY, DOG_XYXY = (16, 32, 64, 80), (32, 64, 112, 88)
CAT_END_X = 40
"""The cat fills the part of its box left of this, the dog all of its box that the cat does not cover."""
_PIXELS_PER_CELL = 4


def labels() -> NDArray[np.uint16]:
    """Which pixels belong to the cat, 1, and to the dog, 2."""
    expected = np.zeros(SIZE_HW, np.uint16)
    expected[64:88, 32:112] = 2
    expected[32:80, 16:CAT_END_X] = 1
    return expected


def rows(*scores: float) -> NDArray[np.float32]:
    """Raw predictions of the cat and the dog with these scores, or of the cat alone, or of nothing."""
    boxes = (CAT_XYXY, DOG_XYXY)
    predicted = np.zeros((len(scores), 9), np.float32)
    for index, ((x1, y1, x2, y2), score) in enumerate(zip(boxes, scores, strict=False)):
        predicted[index, :5] = ((x1 + x2) / 2, (y1 + y2) / 2, x2 - x1, y2 - y1, 1.0)
        predicted[index, 5 + index] = score
        predicted[index, 7 + index] = 5.0
    return predicted


class SegmentingModel:
    """Makes the next models of `prepare` segment the scene; `computed` counts the images with prototypes."""

    def __init__(self, prepare: Preparations) -> None:
        self.computed = 0
        prepare.mask_coefficients = 2
        prepare.run = lambda: rows(0.9, 0.8)
        prepare.compute_prototypes = self._compute_prototypes

    def _compute_prototypes(self) -> NDArray[np.float32]:
        self.computed += 1
        height, width = (pixels // _PIXELS_PER_CELL for pixels in SIZE_HW)
        prototypes = np.ones((2, height, width), np.float32)
        prototypes[0, :, CAT_END_X // _PIXELS_PER_CELL :] = -1
        return prototypes


class MasksSubscriber(Viewer):
    """Receives the masks of `camera`, which shows the scene."""

    def __init__(self, camera: CameraClient) -> None:
        super().__init__(camera, "masks")

    def segment(self) -> tuple[Detection2DArray, Image]:
        """The detections and masks of the next image."""
        array = self._camera.see()
        return array, self.of(array.header)


def pixels(message: Image) -> NDArray[np.uint16]:
    """The labels in a message, in the byte order that it names."""
    order = ">" if message.is_bigendian else "<"
    return np.frombuffer(bytes(message.data), f"{order}u2").reshape(message.height, message.step // 2)
