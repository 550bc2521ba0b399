"""What the camera publishes: images, raw and compressed, camera info, depth and ground truth."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from std_msgs.msg import Header
from vision_msgs.msg import Detection2DArray, Detection3DArray

from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.images.compressed import encode_jpeg
from yolov5_lifecycle.images.encodings import encoded
from yolov5_lifecycle.images.image import ColourImage
from yolov5_lifecycle.ros.camera.settings import CameraSettings
from yolov5_lifecycle.ros.messages import (
    compressed_image_message,
    detection_3d_array_message,
    detection_array,
    image_message,
)
from yolov5_lifecycle.sources.camera_info import CameraInfoValues
from yolov5_lifecycle.sources.frames import SourceError, SourceFrame
from yolov5_lifecycle.sources.scene import CLASS_NAMES, Truth, label_image, truth_of
from yolov5_lifecycle.sources.scene_depth import DepthFrame
from yolov5_lifecycle.spatial.placement import Box3D


def raw_message(image: ColourImage, encoding: str, header: Header) -> Image:
    """Image message of `image` in `encoding`."""
    return image_message(encoded(image, encoding), encoding, header)


def jpeg_message(image: ColourImage, encoding: str, header: Header) -> CompressedImage:
    """JPEG message of `image`, which image_transport decompresses to `encoding`."""
    jpeg = encode_jpeg(image, "mono8" if encoding == "mono8" else "bgr8")
    return compressed_image_message(jpeg, encoding, header)


_FORMS: dict[str, tuple[str, type, Callable[[ColourImage, str, Header], Any]]] = {
    "raw": ("", Image, raw_message),
    "compressed": ("/compressed", CompressedImage, jpeg_message),
}
"""Topic suffix, message type, and the function that creates the message."""


class CameraOutputs:
    """Owns the publishers of images, `camera_info` in the same namespace, ground truth and depth.

    Image topics, `camera_info` and those of depth follow the remapping of `image_raw`, as with
    image_transport. `camera_info` describes the camera of the scene with depth, else that of the settings,
    if any, and is transient local. `~/truth` has the shapes of the synthetic scene with their true
    identities, `~/ground_truth_masks` their pixels. The camera sends both, and depth, before the image.
    Messages are created only for subscribers.

    Raises RuntimeError or ParameterException for invalid `qos_overrides`, and SettingsError for an invalid
    `camera_info_url`.
    """

    def __init__(self, node: Node, settings: CameraSettings) -> None:
        self._node = node
        self._settings = settings
        self._camera_info = settings.camera_info
        topic = node.resolve_topic_name("image_raw")
        offered = ReliabilityPolicy[settings.reliability.upper()]
        self._images = [
            (_publisher(node, message_type, f"{topic}{suffix}", reliability=offered), message)
            for form, (suffix, message_type, message) in _FORMS.items()
            if settings.image_transport in (form, "both")
        ]
        folder = topic.rpartition("/")[0]
        latched = DurabilityPolicy.TRANSIENT_LOCAL  # late subscribers get the last one
        self._infos = _publisher(node, CameraInfo, f"{folder}/camera_info", durability=latched)
        self._truths = node.create_publisher(Detection2DArray, "~/truth", 10)
        self._true_masks = node.create_publisher(Image, "~/ground_truth_masks", 10)
        self._depth: list[Any] = []
        if settings.depth:
            self._depth = [
                node.create_publisher(Detection3DArray, "~/ground_truth_3d", 10),
                _publisher(node, CameraInfo, f"{folder}/depth/camera_info", durability=latched),
                _publisher(node, Image, f"{folder}/depth/image_raw", reliability=offered),
            ]

    @property
    def topics(self) -> str:
        """Full names of the image topics, in words."""
        return " and ".join(publisher.topic_name for publisher, _ in self._images)

    @property
    def is_heard(self) -> bool:
        """Whether the images have a subscriber."""
        return any(publisher.get_subscription_count() for publisher, _ in self._images)

    def publish(self, frame: SourceFrame) -> None:
        """Publish one frame, stamped now, on each image topic that has a subscriber.

        Raises SourceError if its size differs from that in `camera_info_url`.
        """
        _check_size(frame, self._camera_info)
        header = Header(stamp=self._node.get_clock().now().to_msg(), frame_id=self._settings.frame_id)
        known = self._camera_info if frame.depth is None else frame.depth.camera_info
        info = camera_info_message(header, frame.image.size_hw, known)
        if frame.shapes:
            self._publish_scene(frame, info)
        for publisher, message in self._images:
            if publisher.get_subscription_count():
                publisher.publish(message(frame.image, self._settings.encoding, header))
        self._infos.publish(info)

    def wait_until_delivered(self, timeout_s: float) -> None:
        """Wait until all reliable subscribers have acknowledged everything, at most `timeout_s`."""
        deadline_s = time.monotonic() + timeout_s
        images = (publisher for publisher, _ in self._images)
        for publisher in (*images, self._infos, self._truths, self._true_masks, *self._depth):
            left_s = max(0.0, deadline_s - time.monotonic())
            publisher.wait_for_all_acked(Duration(seconds=left_s))

    def _publish_scene(self, frame: SourceFrame, info: CameraInfo) -> None:
        truth = truth_of(frame.shapes, frame.image.size_hw)
        truths = detection_array(_certain(truth), CLASS_NAMES, info.header)
        if self._truths.get_subscription_count():
            self._truths.publish(truths)
        if self._true_masks.get_subscription_count():
            labels = label_image([shape.outline() for shape in frame.shapes], frame.image.size_hw)
            self._true_masks.publish(image_message(labels, "16UC1", info.header))
        if frame.depth is not None:
            self._publish_depth(frame.depth, truths, info)

    def _publish_depth(self, depth: DepthFrame, truths: Detection2DArray, info: CameraInfo) -> None:
        places, infos, images = self._depth
        if places.get_subscription_count():
            places.publish(detection_3d_array_message(truths, _boxes(depth), info.header.frame_id))
        infos.publish(info)
        if images.get_subscription_count():
            images.publish(image_message(depth.depth_mm, "16UC1", info.header))


def _publisher(node: Node, message_type: type, topic: str, **policies: Any) -> Any:
    """Publisher that keeps the last message, with these `policies` unless `qos_overrides` set others."""
    overridable = QoSOverridingOptions.with_default_policies()
    qos = QoSProfile(depth=1, **policies)
    return node.create_publisher(message_type, topic, qos, qos_overriding_options=overridable)


def _boxes(depth: DepthFrame) -> list[Box3D]:
    places = zip(depth.centres_xyz_m.tolist(), depth.sizes_xyz_m.tolist(), strict=True)
    return [Box3D(tuple(centre), tuple(size)) for centre, size in places]


def camera_info_message(
    header: Header, size_hw: tuple[int, int], known: CameraInfoValues | None
) -> CameraInfo:
    """CameraInfo for an image of `size_hw`; without `known` zero matrices, which mean uncalibrated."""
    info = CameraInfo(header=header, height=size_hw[0], width=size_hw[1])
    if known is not None:
        info.distortion_model = known.distortion_model
        info.d = known.distortion_coefficients.data
        info.k = known.camera_matrix.data
        info.r = known.rectification_matrix.data
        info.p = known.projection_matrix.data
    return info


def _check_size(frame: SourceFrame, known: CameraInfoValues | None) -> None:
    if known is None or frame.image.size_hw == known.size_hw:
        return
    (height, width), (calibrated_height, calibrated_width) = frame.image.size_hw, known.size_hw
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
