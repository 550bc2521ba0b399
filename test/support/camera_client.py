"""What a client sees of one camera of a served node: its images, detections and diagnostics."""

from __future__ import annotations

import numpy as np
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from vision_msgs.msg import Detection2DArray, Detection3DArray

from support.depth_messages import camera_info_message, depth_message
from support.served_node import ServedNode, image
from yolov5_lifecycle.images.compressed import encode_jpeg
from yolov5_lifecycle.ros.messages import compressed_image_message, image_of_message

SIZE_HW = (48, 64)


class CameraClient:
    """Publishes images of the camera `name`, as JPEG if `is_compressed`.

    Receives its detections if `is_listening`.
    """

    def __init__(
        self, served: ServedNode, name: str, *, is_listening: bool = True, is_compressed: bool = False
    ) -> None:
        self.served = served
        self.name = name
        self.detections: list[Detection2DArray] = []
        self._is_compressed = is_compressed
        topic, kind = ("image_raw/compressed", CompressedImage) if is_compressed else ("image_raw", Image)
        self.images = served.client.create_publisher(kind, self.topic(topic), 1)
        if is_listening:
            self.listen()
        self._sent = 0

    def topic(self, name: str) -> str:
        """The full name of one of the camera's topics."""
        return f"/yolov5/{self.name}/{name}"

    def listen(self) -> None:
        topic = self.topic("detections")
        self.served.client.create_subscription(Detection2DArray, topic, self.detections.append, 10)

    def send(self, message: Image | None = None) -> int:
        """Send an image; the seconds of its stamp."""
        self._sent += 1
        message = message or image(*SIZE_HW)
        message.header.stamp.sec = self._sent
        message.header.frame_id = f"{self.name}_optical"
        self.images.publish(_compressed(message) if self._is_compressed else message)
        return self._sent

    def wait_for(self, sec: int) -> None:
        """Wait for the detections in the image with this stamp, in seconds."""
        is_there = lambda: bool(self.detections) and self.detections[-1].header.stamp.sec == sec  # noqa: E731
        self.served.wait_for(is_there, f"detections of {self.name}")

    def detect(self) -> Detection2DArray:
        """Send images until one of them is detected; what was found in it."""
        first_sec = self._sent + 1

        def is_detected() -> bool:
            self.send()
            return bool(self.detections) and self.detections[-1].header.stamp.sec >= first_sec

        self.served.wait_for(is_detected, f"a detection of {self.name}")
        return self.detections[-1]

    def track(self) -> str:
        """Send images until the only object in them has an id."""
        self.served.wait_for(lambda: self.detect().detections[0].id != "", f"a track of {self.name}")
        return str(self.detections[-1].detections[0].id)

    def values(self) -> dict[str, str]:
        """The values of the camera's next diagnostic status."""
        return {item.key: item.value for item in self.served.statuses()[self.name].values}

    def counts(self) -> dict[str, int]:
        """Frames by what became of them."""
        return self.served.counts_of(self.values())


class DepthCameraClient(CameraClient):
    """A camera with depth, which sees a wall at `wall_m` metres; receives detections in space."""

    def __init__(self, served: ServedNode, name: str, *, wall_m: float) -> None:
        super().__init__(served, name)
        self.placed: list[Detection3DArray] = []
        self._wall_m = np.full(SIZE_HW, wall_m, np.float32)
        node = served.client
        self.depth = node.create_publisher(Image, self.topic("depth/image_raw"), 2)
        self.info = node.create_publisher(CameraInfo, self.topic("depth/camera_info"), 2)
        node.create_subscription(Detection3DArray, self.topic("detections_3d"), self.placed.append, 10)

    def send_depth(self, stamp_s: float, *, encoding: str = "16UC1") -> None:
        """Send a depth image and its camera_info."""
        height, width = SIZE_HW
        info = camera_info_message(stamp_s, height=height, width=width)
        message = depth_message(self._wall_m, stamp_s)
        message.encoding = encoding
        for sent in (info, message):
            sent.header.frame_id = f"{self.name}_depth"
        self.info.publish(info)
        self.depth.publish(message)

    def place(self) -> Detection3DArray:
        """Send images with depth until one is placed; what was published in space."""
        first_sec = self._sent + 1

        def is_placed() -> bool:
            # Messages of different topics arrive in any order: perhaps the next one is paired.
            self.send_depth(self._sent + 1)
            self.detect()
            return bool(self.placed) and self.placed[-1].header.stamp.sec >= first_sec

        self.served.wait_for(is_placed, f"detections of {self.name} in space")
        return self.placed[-1]


def _compressed(message: Image) -> CompressedImage:
    jpeg = encode_jpeg(image_of_message(message))
    return compressed_image_message(jpeg, message.encoding, message.header)
