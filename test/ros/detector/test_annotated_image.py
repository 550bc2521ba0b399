"""The annotated image shows what is published: boxes, scores, ids of tracks and distances."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from numpy.typing import NDArray
from rclpy.qos import QoSProfile
from sensor_msgs.msg import Image
from support.depth_client import DEPTH_ON, DepthClient
from support.depth_messages import camera_info_message, depth_message
from support.depth_scene import CAMERA, DepthScene
from support.preparations import CLASS_NAMES, Preparations
from support.served_node import ServedNode, image
from vision_msgs.msg import Detection2D, Detection2DArray, Detection3DArray

from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.detection.draw import annotate
from yolov5_lifecycle.images.image import ColourImage
from yolov5_lifecycle.ros.messages import image_of_message

TRACKED = (*DEPTH_ON, "tracker:=bytetrack", "track_timeout:=60.0")
BOX_XYXY = np.array([120, 80, 200, 160], np.float32)
DISTANCE_M = 2.4


def board(distance_m: float) -> DepthScene:
    """A board in the middle of the image, and a wall at 6 m."""
    depth_m = np.full(CAMERA.size_hw, 6.0, np.float32)
    depth_m[80:160, 120:200] = distance_m
    return DepthScene(depth_m, BOX_XYXY, np.array([0.0, 0.0, distance_m]), np.array([1.0, 1.0, 0.0]))


class Viewer:
    """Receives annotated images and finds the messages for the same image."""

    def __init__(self, client: DepthClient) -> None:
        self._client = client
        self._images: list[Image] = []
        node = client.served.client
        node.create_subscription(Image, "/yolov5/image", self._images.append, QoSProfile(depth=10))
        client.served.wait_for(self._sees_something, "the node to discover the subscriber")

    def _sees_something(self) -> bool:
        self._client.detect(self._client.next_stamp_s())
        return bool(self._images)

    def image_of(self, array: Detection2DArray) -> NDArray[np.uint8]:
        """The pixels (H, W, 3) of the annotated image with the header of `array`."""

        def drawn() -> list[Image]:
            return [message for message in self._images if message.header == array.header]

        self._client.served.wait_for(lambda: bool(drawn()), "the annotated image")
        return image_of_message(drawn()[0]).pixels


@pytest.fixture
def client(prepare: Preparations) -> Iterator[DepthClient]:
    with ServedNode(prepare, parameters=TRACKED) as served:
        client = DepthClient(served, prepare)
        client.begin()
        client.show(board(DISTANCE_M))
        yield client
    assert served.escaped == []


def tracked_and_placed(client: DepthClient) -> tuple[Detection2DArray, Detection3DArray]:
    """Detections in the image and in space of the same image, once they have an id."""
    placed = client.place(board(DISTANCE_M))
    while not placed.detections[0].id:
        placed = client.place(board(DISTANCE_M))
    stamp = placed.header.stamp
    return next(array for array in client.served.detections if array.header.stamp == stamp), placed


def corners_xyxy(detection: Detection2D) -> list[float]:
    centre, box = detection.bbox.center.position, detection.bbox
    return [
        centre.x - box.size_x / 2,
        centre.y - box.size_y / 2,
        centre.x + box.size_x / 2,
        centre.y + box.size_y / 2,
    ]


def drawn(array: Detection2DArray, distance_m: float | None, *, has_ids: bool = True) -> NDArray[np.uint8]:
    """The grey source image with the detections of `array`, as detection/draw.py draws them."""
    found = array.detections
    detections = Detections(
        np.array([corners_xyxy(one) for one in found], np.float32),
        np.array([one.results[0].hypothesis.score for one in found], np.float32),
        np.array([CLASS_NAMES.index(one.results[0].hypothesis.class_id) for one in found], np.int64),
        track_ids=tuple(one.id for one in found) if has_ids else (),
    )
    source = ColourImage(image_of_message(image(*CAMERA.size_hw)).pixels, "rgb")
    return annotate(source, detections, CLASS_NAMES, distances_m=[distance_m])


def test_the_distance_and_the_id_of_the_track_are_drawn(client: DepthClient) -> None:
    viewer = Viewer(client)
    found, placed = tracked_and_placed(client)
    seen = viewer.image_of(found)
    position = placed.detections[0].bbox.center.position
    assert np.linalg.norm((position.x, position.y, position.z)) == pytest.approx(DISTANCE_M, abs=0.04)
    np.testing.assert_array_equal(seen, drawn(found, DISTANCE_M))
    assert (seen != drawn(found, None)).any()
    assert (seen != drawn(found, DISTANCE_M, has_ids=False)).any()


def test_an_image_without_depth_shows_no_distance(client: DepthClient) -> None:
    viewer = Viewer(client)
    found, _ = tracked_and_placed(client)
    viewer.image_of(found)
    client.detect(client.next_stamp_s())  # without a depth image of its time
    last = client.served.detections[-1]
    np.testing.assert_array_equal(viewer.image_of(last), drawn(last, None))


def test_distances_are_drawn_although_nobody_asks_for_detections_in_space(client: DepthClient) -> None:
    viewer = Viewer(client)
    client.served.client.destroy_subscription(client.subscription)

    def is_shown() -> bool:
        stamp_s = client.next_stamp_s()
        client.info.publish(camera_info_message(stamp_s))
        client.depth.publish(depth_message(board(DISTANCE_M).depth_m, stamp_s))
        client.detect(stamp_s)
        last = client.served.detections[-1]
        return bool((viewer.image_of(last) == drawn(last, DISTANCE_M)).all())

    client.served.wait_for(is_shown, "a distance in the image")
