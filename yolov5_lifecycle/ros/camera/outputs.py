"""The camera's publishers: images, raw and compressed, camera info, ground truth of the synthetic scene."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from std_msgs.msg import Header
from vision_msgs.msg import Detection2DArray

from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.images.compressed import encode_jpeg
from yolov5_lifecycle.images.encodings import encoded
from yolov5_lifecycle.images.image import ColourImage
from yolov5_lifecycle.ros.camera.settings import CameraSettings, Transport
from yolov5_lifecycle.ros.messages import compressed_image_message, detection_array, image_message
from yolov5_lifecycle.sources.calibration import Calibration
from yolov5_lifecycle.sources.frames import SourceError, SourceFrame
from yolov5_lifecycle.sources.scene import CLASS_NAMES, Truth

_RELIABILITIES = {"reliable": ReliabilityPolicy.RELIABLE, "best_effort": ReliabilityPolicy.BEST_EFFORT}


def raw_message(image: ColourImage, encoding: str, header: Header) -> Image:
    """Image message of `image` in `encoding`."""
    return image_message(encoded(image, encoding), encoding, header)


def jpeg_message(image: ColourImage, encoding: str, header: Header) -> CompressedImage:
    """JPEG message of `image`, which image_transport decompresses to `encoding`."""
    jpeg = encode_jpeg(image, "mono8" if encoding == "mono8" else "bgr8")
    return compressed_image_message(jpeg, encoding, header)


class ImageForm(NamedTuple):
    """Topic suffix, message type, and the function that creates the message."""

    suffix: str
    message_type: type
    message: Callable[[ColourImage, str, Header], Any]


_RAW = ImageForm("", Image, raw_message)
_COMPRESSED = ImageForm("/compressed", CompressedImage, jpeg_message)

IMAGE_FORMS: dict[Transport, list[ImageForm]] = {
    "raw": [_RAW],
    "compressed": [_COMPRESSED],
    "both": [_RAW, _COMPRESSED],
}


class CameraOutputs:
    """Owns the publishers of the images, of `camera_info` in the same namespace, and of `~/truth`.

    Image topics and `camera_info` follow the remapping of `image_raw`, as with image_transport. `camera_info`
    has the calibration of the settings, if any, and is transient local. `~/truth` has the shapes of the
    synthetic scene with their true identities, sent before their image. `forms` create the image messages,
    only for subscribers.

    Raises RuntimeError or ParameterException for invalid `qos_overrides`, and SettingsError for an invalid
    calibration.
    """

    def __init__(
        self,
        node: Node,
        settings: CameraSettings,
        *,
        forms: Mapping[Transport, Sequence[ImageForm]] = IMAGE_FORMS,
    ) -> None:
        self._node = node
        self._settings = settings
        self._calibration = settings.calibration
        topic = node.resolve_topic_name("image_raw")
        offered = _RELIABILITIES[settings.reliability]
        self._images = [
            (self._publisher(form.message_type, f"{topic}{form.suffix}", reliability=offered), form.message)
            for form in forms[settings.image_transport]
        ]
        self._infos = self._publisher(
            CameraInfo,
            f"{topic.rpartition('/')[0]}/camera_info",
            durability=DurabilityPolicy.TRANSIENT_LOCAL,
        )
        self._truths = node.create_publisher(Detection2DArray, "~/truth", 10)

    @property
    def image_topics(self) -> list[str]:
        """Full names of the image topics."""
        return [publisher.topic_name for publisher, _ in self._images]

    @property
    def is_heard(self) -> bool:
        """Whether the images have a subscriber."""
        return any(publisher.get_subscription_count() for publisher, _ in self._images)

    def publish(self, frame: SourceFrame) -> None:
        """Publish one frame, stamped now, on each image topic that has a subscriber.

        Raises SourceError if its size differs from that of the calibration.
        """
        _check_calibrated(frame, self._calibration)
        header = Header(stamp=self._node.get_clock().now().to_msg(), frame_id=self._settings.frame_id)
        if frame.truth is not None and self._truths.get_subscription_count():
            self._truths.publish(detection_array(_certain(frame.truth), CLASS_NAMES, header))
        for publisher, message in self._images:
            if publisher.get_subscription_count():
                publisher.publish(message(frame.image, self._settings.encoding, header))
        self._infos.publish(camera_info(header, frame.image.size_hw, self._calibration))

    def wait_until_delivered(self, timeout_s: float) -> None:
        """Wait until all reliable subscribers have acknowledged everything, at most `timeout_s`."""
        deadline_s = time.monotonic() + timeout_s
        for publisher in (*(publisher for publisher, _ in self._images), self._infos, self._truths):
            left_s = max(0.0, deadline_s - time.monotonic())
            publisher.wait_for_all_acked(Duration(seconds=left_s))

    def _publisher(self, message_type: type, topic: str, **policies: Any) -> Any:
        overridable = QoSOverridingOptions.with_default_policies()
        qos = QoSProfile(depth=1, **policies)
        return self._node.create_publisher(message_type, topic, qos, qos_overriding_options=overridable)


def camera_info(header: Header, size_hw: tuple[int, int], calibration: Calibration | None) -> CameraInfo:
    """CameraInfo for an image of `size_hw`; zero matrices, which mean uncalibrated, without calibration."""
    info = CameraInfo(header=header, height=size_hw[0], width=size_hw[1])
    if calibration is not None:
        info.distortion_model = calibration.distortion_model
        info.d = calibration.distortion_coefficients.data
        info.k = calibration.camera_matrix.data
        info.r = calibration.rectification_matrix.data
        info.p = calibration.projection_matrix.data
    return info


def _check_calibrated(frame: SourceFrame, calibration: Calibration | None) -> None:
    if calibration is None or frame.image.size_hw == calibration.size_hw:
        return
    (height, width), (calibrated_height, calibrated_width) = frame.image.size_hw, calibration.size_hw
    raise SourceError(
        f"The images are {width} x {height}, but camera_info_url has the calibration for "
        f"{calibrated_width} x {calibrated_height}: calibrate again at this size, or set width and height if "
        "the camera has a mode of that size and the same field of view."
    )


def _certain(truth: Truth) -> Detections:
    """Ground truth as detections with score 1; the number of each shape, from 1, is the id of its track."""
    count = len(truth.boxes_xyxy)
    return Detections(
        boxes_xyxy=truth.boxes_xyxy,
        scores=np.ones(count, np.float32),
        class_ids=truth.class_ids,
        track_ids=tuple(str(number) for number in range(1, count + 1)),
    )
