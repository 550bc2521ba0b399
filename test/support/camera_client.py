"""What a client sees of one camera of a served node: its images, detections and diagnostics."""

from __future__ import annotations

from sensor_msgs.msg import Image
from vision_msgs.msg import Detection2DArray

from support.served_node import ServedNode, image


class CameraClient:
    """Publishes images of the camera `name` and receives its detections, if `is_listening`."""

    def __init__(self, served: ServedNode, name: str, *, is_listening: bool = True) -> None:
        self.served = served
        self.name = name
        self.detections: list[Detection2DArray] = []
        self.images = served.client.create_publisher(Image, f"/yolov5/{name}/image_raw", 1)
        if is_listening:
            self.listen()
        self.sent = 0

    def listen(self) -> None:
        topic = f"/yolov5/{self.name}/detections"
        self.served.client.create_subscription(Detection2DArray, topic, self.detections.append, 10)

    def send(self, message: Image | None = None) -> int:
        """Send an image; the seconds of its stamp."""
        self.sent += 1
        message = message or image()
        message.header.stamp.sec = self.sent
        message.header.frame_id = f"{self.name}_optical"
        self.images.publish(message)
        return self.sent

    def wait_for(self, sec: int) -> None:
        """Wait for the detections in the image with this stamp, in seconds."""
        is_there = lambda: bool(self.detections) and self.detections[-1].header.stamp.sec == sec  # noqa: E731
        self.served.wait_for(is_there, f"detections of {self.name}")

    def detect(self) -> Detection2DArray:
        """Send images until one of them is detected; what was found in it."""
        first_sec = self.sent + 1

        def is_detected() -> bool:
            self.send()
            return bool(self.detections) and self.detections[-1].header.stamp.sec >= first_sec

        self.served.wait_for(is_detected, f"a detection of {self.name}")
        return self.detections[-1]

    def values(self) -> dict[str, str]:
        """The values of the camera's next diagnostic status."""
        return {item.key: item.value for item in self.served.statuses()[self.name].values}

    def counts(self) -> dict[str, int]:
        """Frames by what became of them."""
        return self.served.counts_of(self.values())
