"""Between ROS messages and the project's own values."""

from __future__ import annotations

from array import array
from collections.abc import Sequence

import numpy as np
from builtin_interfaces.msg import Time
from numpy.typing import NDArray
from sensor_msgs.msg import CompressedImage, Image
from std_msgs.msg import Header
from vision_msgs.msg import (
    BoundingBox2D,
    Detection2D,
    Detection2DArray,
    LabelInfo,
    ObjectHypothesis,
    ObjectHypothesisWithPose,
    VisionClass,
)

from yolov5_lifecycle.detections import Detections
from yolov5_lifecycle.found_objects import FoundObject, found_objects
from yolov5_lifecycle.images import Picture
from yolov5_lifecycle.message_pictures import compressed_picture, raw_picture


def picture(message: Image | CompressedImage) -> Picture:
    """The picture in `message`, without a copy where the encoding allows; raises ImageError."""
    return compressed_picture(message) if isinstance(message, CompressedImage) else raw_picture(message)


def image_message(pixels: NDArray[np.uint8], encoding: str, header: Header) -> Image:
    """An Image of (H, W, channels) pixels laid out as `encoding` says."""
    height, width, channels = pixels.shape
    message = Image(
        header=header, height=height, width=width, encoding=encoding, is_bigendian=0, step=width * channels
    )
    message.data = _array_of(pixels)
    return message


def compressed_image_message(jpeg: NDArray[np.uint8], encoding: str, header: Header) -> CompressedImage:
    """A CompressedImage of the bytes of a JPEG file, which image_transport will unpack to `encoding`."""
    # Written as image_transport writes it: what was compressed, how, and its colours, for greys no word.
    colours = "" if encoding == "mono8" else "bgr8"
    message = CompressedImage(header=header, format=f"{encoding}; jpeg compressed {colours}")
    message.data = _array_of(jpeg)
    return message


def _array_of(values: NDArray[np.uint8]) -> array[int]:
    # Messages iterate over every byte of anything but an array (ros2/rclpy#836): 127 ms for 640x480 pixels.
    buffer = array("B")
    buffer.frombytes(np.ascontiguousarray(values).data.cast("B"))
    return buffer


def detection_array(detections: Detections, class_names: Sequence[str], header: Header) -> Detection2DArray:
    """Detections in source pixels with the header of the image they are from."""
    found = found_objects(detections, class_names)
    return Detection2DArray(header=header, detections=[_detection(one, header) for one in found])


def _detection(found: FoundObject, header: Header) -> Detection2D:
    bbox = BoundingBox2D(size_x=found.size_xy[0], size_y=found.size_xy[1])
    bbox.center.position.x, bbox.center.position.y = found.centre_xy
    hypothesis = ObjectHypothesis(class_id=found.class_name, score=found.score)
    return Detection2D(header=header, results=[ObjectHypothesisWithPose(hypothesis=hypothesis)], bbox=bbox)


def label_info(class_names: Sequence[str], confidence_threshold: float, stamp: Time) -> LabelInfo:
    """The names behind the class indices of the loaded model and the threshold in force."""
    return LabelInfo(
        header=Header(stamp=stamp),
        class_map=[VisionClass(class_id=index, class_name=name) for index, name in enumerate(class_names)],
        threshold=confidence_threshold,
    )
