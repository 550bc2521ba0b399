"""Depth, tracks and images of several cameras: each camera has its own, with its own settings."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from support.camera_client import CameraClient, DepthCameraClient
from support.preparations import Preparations
from support.served_node import ServedNode, class_ids_of
from vision_msgs.msg import Detection3DArray

CAMERAS = ("front", "rear")
WALLS_M = {"front": 2.0, "rear": 3.0}
TRACKING = ("tracker:=bytetrack", "track_timeout:=60.0")


@contextmanager
def active(prepare: Preparations, *parameters: str) -> Iterator[ServedNode]:
    """The node with two cameras and these `parameters`."""
    with ServedNode(prepare, parameters=["cameras:=[front, rear]", *parameters]) as served:
        served.bring_to("active")
        yield served
    assert served.escaped == []


def depth_cameras(served: ServedNode) -> list[DepthCameraClient]:
    return [DepthCameraClient(served, name, wall_m=WALLS_M[name]) for name in CAMERAS]


def ids_of(array: Detection3DArray) -> list[str]:
    return [detection.id for detection in array.detections]


def test_each_camera_places_its_detections_in_its_own_frame(prepare: Preparations) -> None:
    with active(prepare, "depth:=true", *TRACKING) as served:
        cameras = depth_cameras(served)
        ids = [camera.track() for camera in cameras]
        assert len(set(ids)) == len(CAMERAS)
        for camera, track_id in zip(cameras, ids, strict=True):
            array = camera.place()
            assert array.header.frame_id == f"{camera.name}_depth"
            assert ids_of(array) == [track_id]
            assert array.detections[0].bbox.center.position.z == pytest.approx(WALLS_M[camera.name], rel=0.01)


def test_depth_and_tracker_may_differ_by_camera(prepare: Preparations) -> None:
    with active(prepare, "front.depth:=true", "rear.tracker:=none", *TRACKING) as served:
        front, rear = depth_cameras(served)
        track_id = front.track()
        assert ids_of(front.place()) == [track_id]
        assert [rear.detect().detections[0].id for _ in range(3)] == [""] * 3
        assert rear.placed == []
        assert served.client.count_subscribers(rear.topic("depth/image_raw")) == 0
        statuses: dict[str, DiagnosticStatus] = {}

        def are_told() -> bool:
            front.place()
            rear.detect()
            statuses.update(served.statuses())
            return [statuses[name].message for name in CAMERAS] == [
                "detecting",
                "~/rear/detections_3d has a subscriber, but nothing is published on it: set depth to true",
            ]

        served.wait_for(are_told, "the status of each")
        values = {name: {item.key for item in statuses[name].values} for name in CAMERAS}
        assert {"tracker", "depth topic"} <= values["front"]
        assert not {"tracker", "depth topic"} & values["rear"]


def test_depth_of_one_camera_is_switched_on_and_off_beside_another(prepare: Preparations) -> None:
    with active(prepare, "depth:=true") as served:
        front, rear = depth_cameras(served)
        front.place()
        rear.place()
        assert served.set(**{"front.depth": False}) == (True, "")
        count = len(front.placed)
        front.send_depth(1.0)
        front.detect()
        rear.place()
        assert len(front.placed) == count
        assert served.set(**{"front.depth": True}) == (True, "")
        front.place()


def test_a_hint_of_depth_is_in_the_status_of_its_camera_only(prepare: Preparations) -> None:
    with active(prepare, "depth:=true") as served:
        front, rear = depth_cameras(served)
        told = "detections have no place in space: depth images are rejected: "

        def is_told() -> bool:
            front.send_depth(1.0, encoding="rgb8")
            front.detect()
            rear.place()
            _, of_front, of_rear = served.diagnostics[-1].status
            return of_front.message.startswith(told) and bool(of_rear.level == DiagnosticStatus.OK)

        served.statuses()
        served.wait_for(is_told, "the hint")
        of_node, of_front, of_rear = served.diagnostics[-1].status
        assert of_front.level == DiagnosticStatus.WARN
        assert of_node.message.startswith(f"front: {told}")
        assert "place in space" not in of_rear.message
        assert rear.values()["depth images rejected"] == "0"


def test_another_tracker_of_one_camera_keeps_the_tracks_of_another(prepare: Preparations) -> None:
    with active(prepare, *TRACKING) as served:
        front, rear = (CameraClient(served, name) for name in CAMERAS)
        ids = front.track(), rear.track()
        assert served.set(**{"front.track_high_threshold": 0.3}) == (True, "")
        assert (front.track(), rear.track()) == ids
        assert served.set(**{"front.tracker": "none"}) == (True, "")
        assert front.detect().detections[0].id == ""
        assert served.set(**{"front.tracker": "bytetrack"}) == (True, "")
        assert front.detect().detections[0].id in ("", "3"), "the track is a new one"
        assert (front.track(), rear.track()) == ("3", ids[1])


def test_no_id_is_used_again_after_another_activation(prepare: Preparations) -> None:
    with active(prepare, *TRACKING) as served:
        front, rear = (CameraClient(served, name) for name in CAMERAS)
        given = [front.track(), rear.track()]
        for _ in range(2):
            assert served.transition("deactivate")
            assert served.transition("activate")
            given += [front.track(), rear.track()]
        assert len(set(given)) == len(given)


def test_one_camera_sends_compressed_images_beside_another_that_does_not(prepare: Preparations) -> None:
    with active(prepare, "front.image_transport:=compressed") as served:
        front, rear = CameraClient(served, "front", is_compressed=True), CameraClient(served, "rear")
        assert [class_ids_of(camera.detect()) for camera in (front, rear)] == [["cat"], ["cat"]]
        topics = [camera.values()["image topic"] for camera in (front, rear)]
        assert topics == ["/yolov5/front/image_raw/compressed", "/yolov5/rear/image_raw"]
        assert served.client.count_subscribers("/yolov5/front/image_raw") == 0
        assert served.set(**{"rear.image_transport": "compressed", "front.image_transport": "raw"}) == (
            True,
            "",
        )
        exchanged = CameraClient(served, "front"), CameraClient(served, "rear", is_compressed=True)
        assert [class_ids_of(camera.detect()) for camera in exchanged] == [["cat"], ["cat"]]


def reliability(served: ServedNode, camera: CameraClient) -> list[str]:
    """Of the subscriptions to the images of the camera."""
    infos = served.client.get_subscriptions_info_by_topic(camera.topic("image_raw"))
    return [info.qos_profile.reliability.name.lower() for info in infos]


def test_the_reliability_of_one_camera_may_be_chosen(prepare: Preparations) -> None:
    with active(prepare, "front.image_reliability:=best_effort") as served:
        front, rear = (CameraClient(served, name) for name in CAMERAS)  # with reliable publishers

        def is_of_front(wanted: str) -> bool:
            return (reliability(served, front), reliability(served, rear)) == ([wanted], ["reliable"])

        served.wait_for(lambda: is_of_front("best_effort"), "the reliability of each")
        assert served.set(**{"front.image_reliability": "reliable"}) == (True, "")
        served.wait_for(lambda: is_of_front("reliable"), "the reliability of each")
        assert served.set(**{"front.image_reliability": "best_effort"}) == (True, "")
        served.wait_for(lambda: is_of_front("best_effort"), "the reliability of each")
        assert [class_ids_of(camera.detect()) for camera in (front, rear)] == [["cat"], ["cat"]]
        told = [camera.values()["image reliability"] for camera in (front, rear)]
        assert told == ["best_effort", "reliable"]
