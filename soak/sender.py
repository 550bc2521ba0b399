"""A publisher of given images."""

from __future__ import annotations

import time
from typing import Any

import cv2
from sensor_msgs.msg import CompressedImage, Image
from support.detector_process import NODE, scene_image

from soak.subject import Subject
from yolov5_lifecycle.ros.messages import image_of_message

_PACE_S = 0.002
"""Pause between images; one sent at once would replace the one before it unprocessed."""
_ANSWER_S = 5.0
TRANSPORTS = {
    "raw": (Image, f"{NODE}/image_raw"),
    "compressed": (CompressedImage, f"{NODE}/image_raw/compressed"),
}


class Sender:
    """Sends images to an active subject; `whole` counts the readable ones."""

    def __init__(self, subject: Subject, transport: str) -> None:
        self._subject = subject
        self._transport = transport
        self._publisher = subject.observer.create_publisher(*TRANSPORTS[transport], 1)
        self.whole = 0
        self.wait_until_heard()

    def wait_until_heard(self) -> None:
        """Wait for the node to subscribe."""
        self._subject.observer.wait_for(
            lambda: self._publisher.get_subscription_count() > 0, "the node to subscribe"
        )

    def wait_until_reliable(self) -> None:
        """Wait for the node to subscribe reliably, as this publisher offers.

        It subscribes as best effort while there is no publisher, and again once it has seen this one. Images
        between the two subscriptions are lost, and counted by neither.
        """
        self._subject.observer.wait_for(
            lambda: self._subject.status().get("image reliability") == "reliable",
            "the node to subscribe reliably",
        )

    def send(self, message: Any) -> None:
        self._publisher.publish(message)
        time.sleep(_PACE_S)

    def send_whole(self) -> None:
        """Send a readable image until it is detected."""
        image = scene_image()
        message = image if self._transport == "raw" else _compressed(image)
        self._subject.detections.clear()
        sent_s = float("-inf")

        def is_detected() -> bool:
            nonlocal sent_s
            if time.monotonic() - sent_s > _ANSWER_S:
                self.send(message)
                self.whole += 1
                sent_s = time.monotonic()
            return any(detections.header == image.header for detections in self._subject.detections)

        self._subject.observer.wait_for(is_detected, "the detections of a whole image")

    def close(self) -> None:
        self._subject.observer.destroy_publisher(self._publisher)


def _compressed(image: Image) -> CompressedImage:
    data = cv2.imencode(".jpg", image_of_message(image).pixels)[1].tobytes()
    return CompressedImage(header=image.header, format="jpeg", data=data)
