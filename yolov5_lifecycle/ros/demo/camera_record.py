"""Messages received about one camera: its ground truth, and the detections in its images."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from rclpy.qos import QoSProfile
from sensor_msgs.msg import Image
from vision_msgs.msg import Detection2DArray, Detection3DArray

from yolov5_lifecycle.images.image import ColourImage
from yolov5_lifecycle.ros.demo.ground_truth import Sighting, stamp_ns
from yolov5_lifecycle.ros.demo.observer import Observer
from yolov5_lifecycle.ros.messages import image_of_message

_KEPT_IMAGES = 20

Places = dict[str, NDArray[np.float64]]
"""Centres (3,) of boxes in space in metres, by id; those without an id are left out."""


@dataclass(frozen=True, eq=False)
class JudgedFrame:
    """An image with known ground truth."""

    truth: Sighting
    true_places: Places
    found: Sighting
    places: Places


class CameraRecord:
    """Subscribes to the ground truth below `camera` and to the detector's topics below `detections`.

    Both are full names, such as `/front` and `/yolov5/front`. The annotated images are received from
    `show_images` on.
    """

    def __init__(self, observer: Observer, *, camera: str, detections: str) -> None:
        self._observer = observer
        self._folder = detections
        self._truths: dict[int, Sighting] = {}
        self._found: dict[int, Sighting] = {}
        self._true_places: dict[int, Places] = {}
        self._places: dict[int, Places] = {}
        self._images: deque[Image] = deque(maxlen=_KEPT_IMAGES)
        for topic, received in ((f"{camera}/truth", self._truths), (f"{detections}/detections", self._found)):
            self._collect(topic, received)
        for topic, places in (
            (f"{camera}/ground_truth_3d", self._true_places),
            (f"{detections}/detections_3d", self._places),
        ):
            self._collect_places(topic, places)

    @property
    def is_seen(self) -> bool:
        """Whether the camera has published ground truth."""
        return bool(self._truths and self._true_places)

    def frames_since(self, begin_ns: int) -> list[JudgedFrame]:
        """What was found in images stamped later than this, in the order of their stamps.

        Images after the last one with places are left out: their places may still arrive.
        """
        known = self._found.keys() & self._truths.keys() & self._true_places.keys()
        end_ns = max(self._places, default=begin_ns)
        return [
            JudgedFrame(
                self._truths[stamp], self._true_places[stamp], self._found[stamp], self._places.get(stamp, {})
            )
            for stamp in sorted(known)
            if begin_ns < stamp <= end_ns
        ]

    def show_images(self) -> None:
        """Subscribe to the annotated images."""
        self._observer.create_subscription(
            Image, f"{self._folder}/image", self._keep_image, QoSProfile(depth=1)
        )

    def complete_image(self, min_objects: int) -> ColourImage | None:
        """An annotated image of at least this many objects, all with an id and a place; None without one."""
        for message in self._images:
            stamp = stamp_ns(message.header)
            if stamp in self._found and stamp in self._places:
                ids = self._found[stamp].ids
                if len(ids) >= min_objects and set(ids) == self._places[stamp].keys():
                    return image_of_message(message)
        return None

    def _keep_image(self, message: Image) -> None:
        self._images.append(message)

    def _collect(self, topic: str, received: dict[int, Sighting]) -> None:
        def take(message: Detection2DArray) -> None:
            received[stamp_ns(message.header)] = Sighting.now(message)

        self._observer.create_subscription(Detection2DArray, topic, take, 10)

    def _collect_places(self, topic: str, received: dict[int, Places]) -> None:
        def take(message: Detection3DArray) -> None:
            received[stamp_ns(message.header)] = _places(message)

        self._observer.create_subscription(Detection3DArray, topic, take, 10)


def _places(message: Detection3DArray) -> Places:
    centres = {detection.id: detection.bbox.center.position for detection in message.detections}
    return {name: np.array([centre.x, centre.y, centre.z]) for name, centre in centres.items() if name}
