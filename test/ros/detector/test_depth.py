"""Detections in space: placed with the depth image of their moment, or counted with the reason."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from itertools import cycle

import numpy as np
import pytest
from numpy.typing import NDArray
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import CameraInfo, Image
from std_msgs.msg import String
from support.depth_client import DEPTH_ON, PADDING_Y, SCENE, DepthClient
from support.depth_messages import DEPTH_FRAME, camera_info_message, depth_message, header, prediction_of
from support.depth_scene import CAMERA, DepthScene, Difficulty, random_depth_scene
from support.hostile_depth import hostile_camera_infos, hostile_depths
from support.preparations import Preparations
from support.served_node import PATIENCE_S, ServedNode, class_ids_of, image
from vision_msgs.msg import Detection3DArray

from yolov5_lifecycle.spatial.stamp_pairing import CAPACITY

EMPTY = np.zeros(CAMERA.size_hw, np.float32)


@pytest.fixture
def client(prepare: Preparations) -> Iterator[DepthClient]:
    with ServedNode(prepare, parameters=DEPTH_ON) as served:
        yield DepthClient(served, prepare)
    assert served.escaped == []


@pytest.mark.long
@pytest.mark.parametrize("encoding", ["16UC1", "32FC1"])
def test_detections_are_placed_where_the_objects_are(client: DepthClient, encoding: str) -> None:
    client.begin()
    rng = np.random.default_rng(11)
    errors = []
    for _ in range(12):
        scene = random_depth_scene(rng, "board", Difficulty(hole_share=0.3))
        client.show(scene)
        array = client.place(scene, encoding=encoding)
        (detection,) = array.detections
        centre = detection.bbox.center.position
        found = np.array([centre.x, centre.y, centre.z])
        errors.append(float(np.linalg.norm(found - scene.centre_xyz_m)) / scene.range_m)
    assert np.median(errors) <= 0.02
    assert sorted(errors)[-2] <= 0.05


def test_the_array_in_space_has_the_stamp_ids_and_scores_of_that_in_the_image(client: DepthClient) -> None:
    client.begin()
    array = client.place()
    plain = next(one for one in client.served.detections if one.header.stamp == array.header.stamp)
    assert plain.header.frame_id == "colour"
    assert array.header.frame_id == DEPTH_FRAME
    (placed,), (detection,) = array.detections, plain.detections
    assert placed.header == array.header
    assert placed.id == detection.id
    assert [result.hypothesis for result in placed.results] == [
        result.hypothesis for result in detection.results
    ]
    status = client.served.status()
    assert status.message == "detecting"
    values = {item.key: item.value for item in status.values}
    assert int(values["detections placed"]) >= 1
    assert int(values["images with depth"]) >= 1


@pytest.mark.long
def test_a_slow_model_places_detections_with_the_depth_image_of_their_moment(
    client: DepthClient, prepare: Preparations
) -> None:
    client.begin()
    client.place()
    rows = prediction_of([SCENE.box_xyxy], padding_y=PADDING_Y)
    entered, release = threading.Event(), threading.Event()

    def slow() -> NDArray[np.float32]:
        entered.set()
        assert release.wait(PATIENCE_S)
        return rows

    prepare.running.run = slow
    stamp_s = client.next_stamp_s()
    client.send(depth_message(SCENE.depth_m, stamp_s), None)
    message = image(*CAMERA.size_hw)
    message.header = header(stamp_s)
    client.served.publish(message)
    client.served.wait_for(entered.is_set, "inference to begin")
    for _ in range(2 * CAPACITY):
        client.send(depth_message(EMPTY, client.next_stamp_s()), None)
    release.set()
    client.served.wait_for(lambda: client.received[-1].header.stamp == message.header.stamp, "its place")
    assert len(client.received[-1].detections) == 1


def test_an_image_without_objects_has_an_empty_array_in_space(
    client: DepthClient, prepare: Preparations
) -> None:
    client.begin()
    client.place()
    prepare.running.run = lambda: np.zeros((1, 7), np.float32)
    assert client.place().detections == []


@pytest.mark.parametrize(
    ("delay_s", "has_info", "reason"),
    [
        pytest.param(None, True, "no depth image", id="none"),
        pytest.param(0.01, False, "no camera_info", id="no camera_info"),
    ],
)
def test_an_image_without_depth_is_detected_and_counted_with_the_reason(
    client: DepthClient, delay_s: float | None, has_info: bool, reason: str
) -> None:
    client.begin()
    stamp_s = client.next_stamp_s()
    client.send(
        None if delay_s is None else depth_message(SCENE.depth_m, stamp_s + delay_s),
        camera_info_message(stamp_s) if has_info else None,
    )
    assert client.detect(stamp_s) == 1
    values = client.values_until(lambda now: now[f"unplaced: {reason}"] == "1", "the count")
    assert values["images without depth"] == "1"
    assert values["detections placed"] == "0"
    assert client.received == [], "an empty array would say that there is no object"


def test_a_detection_without_measurements_is_in_the_image_only(client: DepthClient) -> None:
    client.begin()
    client.place()
    blind = DepthScene(EMPTY, SCENE.box_xyxy, SCENE.centre_xyz_m, SCENE.size_xyz_m)
    array = client.place(blind)
    assert array.detections == []
    assert len(client.served.detections[-1].detections) == 1
    client.values_until(lambda now: int(now["unplaced: no valid depth in box"]) > 0, "the count")


def test_hostile_messages_are_rejected_counted_and_explained_and_the_next_is_used(
    client: DepthClient,
) -> None:
    client.begin()
    client.place()
    depths, infos = hostile_depths().values(), hostile_camera_infos().values()

    def are_rejected() -> bool:
        client.served.images.publish(image(*CAMERA.size_hw))
        for depth, info in zip(depths, cycle(infos), strict=False):
            client.depth.publish(depth)
            client.info.publish(info)
        status = client.served.diagnostics[-1].status[0]
        values = {item.key: item.value for item in status.values}
        fewest = min(int(values[f"{what} rejected"]) for what in ("depth images", "camera_infos"))
        return fewest >= 100 and "no place in space: " in status.message

    client.served.status()
    client.served.wait_for(are_rejected, "a hundred rejections and the hint")
    client.served.wait_for_log("depth image rejected: ")
    client.served.wait_for_log("camera_info rejected: ")
    assert client.detect(client.next_stamp_s()) == 1
    assert len(client.place().detections) == 1


def test_depth_is_switched_on_and_off_while_the_node_detects(prepare: Preparations) -> None:
    with ServedNode(prepare, parameters=["image_size:=320"]) as served:
        client = DepthClient(served, prepare)
        served.bring_to("active")
        client.show(SCENE)
        told = "~/detections_3d has a subscriber, but nothing is published on it: set depth to true"

        def is_told() -> bool:
            assert client.detect(client.next_stamp_s()) == 1
            return bool(served.status().message == told)

        served.wait_for(is_told, "the remark")
        assert "depth images received" not in served.values()
        assert served.client.count_subscribers("/yolov5/depth/image_raw") == 0
        assert served.set(depth=True) == (True, "")
        client.wait_for_depth()
        assert len(client.place().detections) == 1
        assert served.set(depth_slop_s=0.2) == (True, "")
        client.wait_for_depth()
        assert len(client.place().detections) == 1
        assert served.set(depth=False) == (True, "")
        client.wait_for_depth(0)
        switched_off_s = client.next_stamp_s()  # what was detected before may still arrive
        served.wait_for(is_told, "the remark")
        assert [array for array in client.received if array.header.stamp.sec >= switched_off_s] == []
    assert served.escaped == []


def test_a_lazy_node_needs_depth_only_for_those_who_show_it(client: DepthClient) -> None:
    client.begin()
    for subscription in list(client.served.client.subscriptions):
        if subscription.topic == "/yolov5/detections":
            client.served.client.destroy_subscription(subscription)
    client.served.wait_for(lambda: client.served.image_subscriptions() == 1, "the node to stay subscribed")
    client.wait_for_depth()
    client.served.client.destroy_subscription(client.subscription)
    client.wait_for_depth(0)
    client.served.wait_for(lambda: client.served.image_subscriptions() == 0, "the node to unsubscribe")
    client.served.client.create_subscription(Image, "/yolov5/image", lambda _: None, 1)
    client.wait_for_depth()
    assert client.served.transition("deactivate")
    client.wait_for_depth(0)


@pytest.mark.long
def test_a_missing_depth_camera_is_named(prepare: Preparations) -> None:
    arguments = ["--ros-args", "-r", "~/depth/image_raw:=/depth/aligned"]
    with ServedNode(prepare, parameters=DEPTH_ON, arguments=arguments) as served:
        served.bring_to("active")
        served.client.create_subscription(Detection3DArray, "/yolov5/detections_3d", lambda _: None, 1)

        def is_told() -> bool:
            served.publish()
            return "no publisher of depth images on /depth/aligned" in served.status().message

        served.wait_for(is_told, "the hint")


@pytest.mark.parametrize("name", ["image_raw", "camera_info"])
def test_a_subscription_that_the_middleware_refuses_is_told_until_it_succeeds(
    prepare: Preparations, name: str
) -> None:
    """Fast DDS has one type for a topic in one process, and the client is in the node's."""
    told = f"cannot subscribe to /yolov5/depth/{name}: "
    with ServedNode(prepare, parameters=DEPTH_ON) as served:
        other = served.client.create_publisher(String, f"/yolov5/depth/{name}", 1)
        served.bring_to("active")
        served.client.create_subscription(Detection3DArray, "/yolov5/detections_3d", lambda _: None, 10)

        def is_told() -> bool:
            assert class_ids_of(served.detect()) == ["cat"]
            message: str = served.status().message
            return message.startswith(told) and message.endswith(": detections have no place in space")

        served.wait_for(is_told, "the hint")
        served.wait_for_log(told)
        served.client.destroy_publisher(other)
        client = DepthClient(served, prepare)
        client.show(SCENE)
        client.wait_for_depth()
        assert len(client.place().detections) == 1
        refusals = [said for said in served.log if told in said and "no place in space" not in said]
        assert len(refusals) == 1, "besides the hint"
    assert served.escaped == []


def test_the_subscription_takes_the_reliability_that_the_depth_cameras_offer(client: DepthClient) -> None:
    client.begin()
    topics = {"/yolov5/depth/image_raw": "BEST_EFFORT", "/yolov5/depth/camera_info": "RELIABLE"}

    def offered() -> dict[str, str]:
        return {
            topic: info.qos_profile.reliability.name
            for topic in topics
            for info in client.served.client.get_subscriptions_info_by_topic(topic)
        }

    client.served.wait_for(lambda: offered() == topics, "the reliability of each")


def test_a_camera_info_that_was_latched_before_the_node_subscribed_is_used(client: DepthClient) -> None:
    node, topic = client.served.client, "/yolov5/depth/camera_info"
    node.destroy_publisher(client.info)
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    client.info = node.create_publisher(CameraInfo, topic, latched)
    client.info.publish(camera_info_message(client.next_stamp_s()))
    client.begin()
    assert len(client.place(with_info=False).detections) == 1
    volatile = node.create_publisher(CameraInfo, topic, 2)
    client.served.wait_for(lambda: volatile.get_subscription_count() == 1, "a subscription that matches both")
