"""Client of one named camera of the detector: sends images and depth, receives detections."""

from __future__ import annotations

import time
from array import array
from typing import Any

import numpy as np
from sensor_msgs.msg import CameraInfo, Image
from support.depth_messages import camera_info_message, depth_message
from support.detector_process import NODE, scene_image
from vision_msgs.msg import Detection2DArray, Detection3DArray

from soak.subject import Subject
from soak.track_ids import TrackIds
from yolov5_lifecycle.ros.messages import stamp_ns

_KEPT = 1000
_ANSWER_S = 2.0
_DEPTH_HW = (240, 320)


class CameraClient:
    """Publishes for the camera `name`, counts its detections and hands their track ids to `track_ids`."""

    def __init__(self, subject: Subject, name: str, track_ids: TrackIds) -> None:
        self.name = name
        self.heard = 0
        self.heard_3d = 0
        self._observer = subject.observer
        self._track_ids = track_ids
        self._last: Any = None
        prefix = f"{NODE}/{name}"
        self._endpoints = [
            self._observer.create_subscription(Detection2DArray, f"{prefix}/detections", self._hear, _KEPT),
            self._observer.create_subscription(
                Detection3DArray, f"{prefix}/detections_3d", self._hear_3d, _KEPT
            ),
        ]
        self._images = self._observer.create_publisher(Image, f"{prefix}/image_raw", 1)
        self._depth = self._observer.create_publisher(Image, f"{prefix}/depth/image_raw", 1)
        self._camera_info = self._observer.create_publisher(CameraInfo, f"{prefix}/depth/camera_info", 1)

    def send(self, image: Image | bytes) -> None:
        self._images.publish(image)

    def send_depth(self) -> None:
        """A wall two metres away, now."""
        now_s = time.time()
        self._camera_info.publish(camera_info_message(now_s))
        self._depth.publish(depth_message(np.full(_DEPTH_HW, 2.0, np.float32), now_s))

    def detect(self) -> None:
        """Send a readable image until it is detected."""
        image = scene_image()
        sent_s = float("-inf")

        def is_detected() -> bool:
            nonlocal sent_s
            if time.monotonic() - sent_s > _ANSWER_S:
                self.send(image)
                sent_s = time.monotonic()
            return bool(self._last == image.header)

        self._observer.wait_for(is_detected, f"the detections of {self.name}")

    def close(self) -> None:
        for subscription in self._endpoints:
            self._observer.destroy_subscription(subscription)
        for publisher in (self._images, self._depth, self._camera_info):
            self._observer.destroy_publisher(publisher)

    def _hear(self, message: Detection2DArray) -> None:
        self.heard += 1
        self._last = message.header
        ids = [detection.id for detection in message.detections]
        self._track_ids.take(self.name, stamp_ns(message.header), ids)

    def _hear_3d(self, _: Detection3DArray) -> None:
        self.heard_3d += 1


def grey_image(size_hw: tuple[int, int]) -> Image:
    """A readable image of any size, without content."""
    height, width = size_hw
    data = array("B", bytes(3 * height * width))
    return Image(height=height, width=width, step=3 * width, encoding="bgr8", data=data)
