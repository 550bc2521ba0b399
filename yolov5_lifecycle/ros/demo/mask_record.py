"""Masks received from the detector and as ground truth, and how well they agree."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import Image

from yolov5_lifecycle.ros.demo.ground_truth import Sighting, matched, stamp_ns
from yolov5_lifecycle.ros.demo.observer import Observer
from yolov5_lifecycle.ros.demo.outcome import DemonstrationError

Labels = NDArray[np.uint16]
"""An image (H, W) with i + 1 for the pixels of the i-th object, 0 for the background."""


class MaskRecord:
    """Subscribes to the detector's masks on the topic `found` and to the camera's on `true`, until closed."""

    def __init__(self, observer: Observer, *, found: str, true: str) -> None:
        self._observer = observer
        self._found: dict[int, Labels] = {}
        self._true: dict[int, Labels] = {}
        self._subscriptions = [self._collect(found, self._found), self._collect(true, self._true)]

    def close(self) -> None:
        """Unsubscribe."""
        for subscription in self._subscriptions:
            self._observer.destroy_subscription(subscription)

    @property
    def stamps_ns(self) -> set[int]:
        """Stamps of the images for which both masks have been received."""
        return self._found.keys() & self._true.keys()

    def ious(self, seen: Sighting, truth: Sighting) -> list[float]:
        """The IoU of the masks of each object that is in both, in an image of `stamps_ns`."""
        stamp = seen.stamp_ns
        return mask_ious(seen, self._found[stamp], truth, self._true[stamp])

    def _collect(self, topic: str, received: dict[int, Labels]) -> object:
        def take(message: Image) -> None:
            received[stamp_ns(message.header)] = labels_of_message(message)

        return self._observer.create_subscription(Image, topic, take, 10)


def labels_of_message(message: Image) -> Labels:
    """The values of a 16UC1 image message; raises DemonstrationError for another encoding."""
    if message.encoding != "16UC1":
        raise DemonstrationError(f"expected masks in the encoding 16UC1, found {message.encoding}")
    dtype = np.dtype(np.uint16).newbyteorder(">" if message.is_bigendian else "<")
    rows = np.frombuffer(message.data, dtype).reshape(message.height, message.step // 2)
    return rows[:, : message.width]


def mask_ious(seen: Sighting, found: Labels, truth: Sighting, true: Labels) -> list[float]:
    """Intersection over union of the pixels `found` and `true` of the objects in both, see `matched`.

    Raises DemonstrationError if the images differ in size.
    """
    if found.shape != true.shape:
        raise DemonstrationError(
            f"expected masks of {true.shape}, the size of the image, found {found.shape}"
        )
    ious = []
    for true_row, row in matched(truth, seen):
        is_found, is_true = found == row + 1, true == true_row + 1
        ious.append(float((is_found & is_true).sum() / max((is_found | is_true).sum(), 1)))
    return ious
