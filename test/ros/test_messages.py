"""Detections in space become a Detection3DArray that belongs to the array of 2D; masks become an image."""

from __future__ import annotations

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from numpy.typing import NDArray
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import Image
from std_msgs.msg import Header
from support.segmented_scene import pixels
from vision_msgs.msg import Detection2DArray, Detection3DArray

from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.ros.messages import detection_3d_array_message, detection_array, image_message
from yolov5_lifecycle.spatial.placement import Box3D, Placement, Unplaced

CUP = Box3D((0.5, -0.25, 2.0), (0.1, 0.2, 0.05))
CAR = Box3D((-3.0, 1.0, 12.0), (2.0, 1.5, 0.5))


def detections_2d(count: int = 2) -> Detection2DArray:
    """`count` of a cup and a car, with the ids of a tracker."""
    found = Detections(
        boxes_xyxy=np.array([[10, 20, 30, 40], [50, 60, 90, 80]], np.float32)[:count],
        scores=np.array([0.75, 0.5], np.float32)[:count],
        class_ids=np.array([0, 1], np.int64)[:count],
    )
    header = Header(stamp=Time(sec=7, nanosec=8), frame_id="color_optical_frame")
    array = detection_array(found, ["cup", "car"], header)
    for index, detection in enumerate(array.detections):
        detection.id = f"track {index}"
    return array


def message(placements: list[Placement]) -> Detection3DArray:
    array = detection_3d_array_message(detections_2d(len(placements)), placements, "depth_optical_frame")
    return deserialize_message(serialize_message(array), Detection3DArray)


def test_every_header_has_the_stamp_of_the_2d_array_and_the_frame_of_the_depth_image() -> None:
    array = message([CUP, CAR])
    header = Header(stamp=Time(sec=7, nanosec=8), frame_id="depth_optical_frame")
    assert [array.header, *(detection.header for detection in array.detections)] == [header] * 3


def test_ids_classes_and_scores_are_those_of_the_2d_array() -> None:
    flat, solid = (
        [
            (
                detection.id,
                [(result.hypothesis.class_id, result.hypothesis.score) for result in detection.results],
            )
            for detection in array.detections
        ]
        for array in (detections_2d(), message([CUP, CAR]))
    )
    assert solid == flat
    assert [name for name, _ in solid] == ["track 0", "track 1"]


@pytest.mark.parametrize(("index", "box"), [(0, CUP), (1, CAR)], ids=["cup", "car"])
def test_a_box_is_upright_in_metres_and_its_centre_is_the_pose_of_the_hypothesis(
    index: int, box: Box3D
) -> None:
    detection = message([CUP, CAR]).detections[index]
    centre, size = detection.bbox.center, detection.bbox.size
    assert (centre.position.x, centre.position.y, centre.position.z) == box.centre_xyz_m
    assert (size.x, size.y, size.z) == box.size_xyz_m
    assert (centre.orientation.x, centre.orientation.y, centre.orientation.z, centre.orientation.w) == (
        0,
        0,
        0,
        1,
    )
    assert detection.results[0].pose.pose == centre


@pytest.mark.parametrize("reason", Unplaced, ids=lambda reason: reason.value)
def test_a_detection_without_a_place_is_left_out(reason: Unplaced) -> None:
    assert [detection.id for detection in message([reason, CAR]).detections] == ["track 1"]


def test_without_detections_the_array_is_empty_but_stamped() -> None:
    array = message([])
    assert list(array.detections) == []
    assert array.header.stamp == Time(sec=7, nanosec=8)


def test_placements_of_another_image_are_refused() -> None:
    with pytest.raises(ValueError, match="argument 2"):
        detection_3d_array_message(detections_2d(), [CUP], "depth_optical_frame")


@pytest.mark.parametrize(
    "label_image",
    [
        pytest.param(np.arange(6, dtype=np.uint16).reshape(2, 3) * 13_000, id="two bytes"),
        pytest.param(np.arange(12, dtype=np.uint16).reshape(3, 4)[:, ::2], id="a view"),
        pytest.param(np.arange(6, dtype=np.dtype(">u2")).reshape(2, 3), id="big-endian"),
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
