"""The camera's publishers of depth: images, camera info, and the places of the scene's shapes in space."""

from __future__ import annotations

from typing import Any

from rclpy.node import Node
from rclpy.qos import ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, Image
from vision_msgs.msg import Detection2DArray, Detection3DArray

from yolov5_lifecycle.ros.camera.publishers import camera_info_publisher, overridable_publisher
from yolov5_lifecycle.ros.messages import depth_image_message, detection_3d_array_message
from yolov5_lifecycle.sources.scene_depth import DepthFrame
from yolov5_lifecycle.spatial.placement import Box3D


class DepthOutputs:
    """Owns the publishers of `image_raw` and `camera_info` in `folder`, and of `~/ground_truth_3d`.

    Raises RuntimeError or ParameterException for invalid `qos_overrides`.
    """

    def __init__(self, node: Node, folder: str, reliability: ReliabilityPolicy) -> None:
        self._images = overridable_publisher(node, Image, f"{folder}/image_raw", reliability=reliability)
        self._infos = camera_info_publisher(node, folder)
        self._truths = node.create_publisher(Detection3DArray, "~/ground_truth_3d", 10)

    @property
    def publishers(self) -> tuple[Any, ...]:
        """All of them."""
        return self._images, self._infos, self._truths

    def publish(self, depth: DepthFrame, truths: Detection2DArray, info: CameraInfo) -> None:
        """Publish the depth of the image that shows `truths`, with the header of `info`."""
        if self._truths.get_subscription_count():
            self._truths.publish(detection_3d_array_message(truths, _boxes(depth), info.header.frame_id))
        self._infos.publish(info)
        if self._images.get_subscription_count():
            self._images.publish(depth_image_message(depth.depth_mm, info.header))


def _boxes(depth: DepthFrame) -> list[Box3D]:
    places = zip(depth.centres_xyz_m.tolist(), depth.sizes_xyz_m.tolist(), strict=True)
    return [Box3D(tuple(centre), tuple(size)) for centre, size in places]
