"""Detections become messages: in the image, in space and as points; masks become an image."""

from __future__ import annotations

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Quaternion
from numpy.typing import NDArray
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import Image, PointCloud2
from std_msgs.msg import Header
from support.point_clouds import points_of
from support.segmented_scene import pixels
from vision_msgs.msg import Detection2DArray, Detection3DArray

from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.images.image import ChannelOrder, ColourImage
from yolov5_lifecycle.ros.messages import (
    detection_3d_array_message,
    detection_array,
    image_message,
    point_cloud_message,
)
from yolov5_lifecycle.spatial.placement import Box3D, Placement, Unplaced
from yolov5_lifecycle.spatial.points import SurfacePoints

CUP = Box3D((0.5, -0.25, 2.0), (0.1, 0.2, 0.05))
CAR = Box3D((-3.0, 1.0, 12.0), (2.0, 1.5, 0.5))


FOUND = Detections(
    boxes_xyxy=np.array([[10, 20, 30, 40], [50, 60, 90, 80]], np.float32),
    scores=np.array([0.75, 0.5], np.float32),
    class_ids=np.array([0, 1], np.int64),
)
BOXES_CXCYWH = [(20, 30, 20, 20), (70, 70, 40, 20)]


def detections_2d(count: int = 2) -> Detection2DArray:
    """`count` of a cup and a car, with the ids of a tracker."""
    header = Header(stamp=Time(sec=7, nanosec=8), frame_id="color_optical_frame")
    array = detection_array(FOUND[:count], ["cup", "car"], header)
    for index, detection in enumerate(array.detections):
        detection.id = f"track {index}"
    return array


def test_each_detection_has_its_class_its_score_and_its_box_in_pixels() -> None:
    array = deserialize_message(serialize_message(detections_2d()), Detection2DArray)
    for detection, *expected in zip(
        array.detections, ("cup", "car"), FOUND.scores, BOXES_CXCYWH, strict=True
    ):
        (hypothesis,) = (each.hypothesis for each in detection.results)
        centre, bbox = detection.bbox.center.position, detection.bbox
        box_cxcywh = (centre.x, centre.y, bbox.size_x, bbox.size_y)
        assert [hypothesis.class_id, hypothesis.score, box_cxcywh] == expected
        assert detection.header == array.header


def message(placements: list[Placement]) -> Detection3DArray:
    array = detection_3d_array_message(detections_2d(len(placements)), placements, "depth_optical_frame")
    return deserialize_message(serialize_message(array), Detection3DArray)


def test_each_detection_has_its_box_in_metres_and_the_rest_of_the_2d_array() -> None:
    header = Header(stamp=Time(sec=7, nanosec=8), frame_id="depth_optical_frame")
    array = message([CUP, CAR])
    assert array.header == header
    for detection, flat, box in zip(array.detections, detections_2d().detections, (CUP, CAR), strict=True):
        assert (detection.header, detection.id) == (header, flat.id)
        assert [each.hypothesis for each in detection.results] == [each.hypothesis for each in flat.results]
        centre, size = detection.bbox.center, detection.bbox.size
        assert (centre.position.x, centre.position.y, centre.position.z) == box.centre_xyz_m
        assert (size.x, size.y, size.z) == box.size_xyz_m
        assert centre.orientation == Quaternion(w=1.0)
        assert detection.results[0].pose.pose == centre


@pytest.mark.parametrize("channel_order", ["rgb", "bgr"])
def test_a_cloud_has_each_point_with_its_colour_and_detection(channel_order: ChannelOrder) -> None:
    shown = np.zeros((48, 70, 3), np.uint8)[:, :64]  # rows have a padding
    shown[30, 40] = (1, 2, 250)
    xyz_m = np.array([[0.5, -0.25, 2], [1, 2, 3], [4, 5, 6]], np.float32)
    points = [
        SurfacePoints(box=0, xyz_m=xyz_m[:1], rows=np.array([30]), columns=np.array([40])),
        SurfacePoints(box=1, xyz_m=xyz_m[1:], rows=np.array([0, 30]), columns=np.array([0, 40])),
    ]
    header = Header(stamp=Time(sec=7, nanosec=8), frame_id="depth_optical_frame")
    message = point_cloud_message(points, FOUND, ColourImage(shown, channel_order), header)
    cloud = deserialize_message(serialize_message(message), PointCloud2)
    assert (cloud.header, cloud.height, cloud.width, cloud.is_dense) == (header, 1, 3, True)
    values = points_of(cloud)
    np.testing.assert_array_equal([values[axis] for axis in "xyz"], xyz_m.T)
    red, blue = (1, 250) if channel_order == "rgb" else (250, 1)
    assert values["rgb"].view(np.uint32).tolist() == [colour := red << 16 | 2 << 8 | blue, 0, colour]
    assert (values["detection"].tolist(), values["class_id"].tolist()) == ([0, 1, 1], [0, 1, 1])
    assert values["score"].tolist() == [0.75, 0.5, 0.5]


def test_a_detection_without_a_place_is_left_out() -> None:
    assert [detection.id for detection in message([next(iter(Unplaced)), CAR]).detections] == ["track 1"]
    array = message([])
    assert list(array.detections) == []
    assert array.header.stamp == Time(sec=7, nanosec=8)


@pytest.mark.parametrize(
    "label_image",
    [
        pytest.param(np.arange(6, dtype=np.uint16).reshape(2, 3) * 13_000, id="two bytes"),
        pytest.param(np.arange(12, dtype=np.dtype(">u2")).reshape(3, 4)[:, ::2], id="a big-endian view"),
    ],
)
def test_masks_are_an_image_of_16_bits_with_the_header_of_the_source(
    label_image: NDArray[np.uint16],
) -> None:
    header = Header(stamp=Time(sec=7, nanosec=8), frame_id="lens")
    message = deserialize_message(serialize_message(image_message(label_image, "16UC1", header)), Image)
    assert message.header == header
    assert (message.encoding, message.is_bigendian) == ("16UC1", 0)
    assert (message.height, message.width) == label_image.shape
    np.testing.assert_array_equal(pixels(message), label_image)
