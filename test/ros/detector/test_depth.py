"""Detections in space: placed with the depth image of their moment, or counted with the reason."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import CameraInfo, Image
from support.camera_client import DepthClient
from support.depth_messages import DEPTH_FRAME, camera_info_message, depth_message, header
from support.depth_scene import CAMERA, random_depth_scene
from support.gate import Gate
from support.lone_node import lone_node
from support.preparations import Preparations, prediction
from support.segmented_scene import PARAMETERS, SIZE_HW, SegmentingModel
from support.served_node import ServedNode

from yolov5_lifecycle.ros.detector.depth import DepthInput, PlacedImage
from yolov5_lifecycle.spatial.placement import Box3D, Unplaced
from yolov5_lifecycle.spatial.stamp_pairing import CAPACITY

# What is received and placed, without a detector


SCENE = random_depth_scene(np.random.default_rng(5), "board")
PIXELS = np.ones((24, 32), np.float32)
LONG_NAME = header(1.0)
LONG_NAME.frame_id = "x" * 100_000
LONG = "frame_id of at most 256 characters, found 100000"
WRONG_DEPTHS: dict[str, dict[str, Any]] = {
    "found encoding 'rgb8'": {"encoding": "rgb8"},
    LONG: {"header": LONG_NAME},
}
"""Changes of a depth image by a part of the reason for which it is rejected."""
WRONG_CAMERA_INFOS: dict[str, dict[str, Any]] = {
    "found fx 0": {"k": [0.0] * 9},
    "found 'division'": {"distortion_model": "division", "d": [0.1]},
    LONG: {"header": LONG_NAME},
}


@pytest.fixture
def depth(ros_domain: int) -> Iterator[DepthInput]:
    with lone_node("yolov5") as node:
        yield DepthInput(node, slop_s=0.05)


def placed(
    depth: DepthInput,
    stamp_s: float = 1.0,
    size_hw: tuple[int, int] = CAMERA.size_hw,
    frame_id: str = DEPTH_FRAME,
) -> PlacedImage | None:
    colour = header(stamp_s)
    colour.frame_id = frame_id
    return depth.place(SCENE.box_xyxy[None], size_hw, colour)


def counted(depth: DepthInput) -> dict[str, int]:
    """The counts that are not 0."""
    return {name: count for name, count in depth.counts.items() if count}


def fill(depth: DepthInput, stamp_s: float = 1.0) -> None:
    depth.take_image(depth_message(SCENE.depth_m, stamp_s))
    depth.take_camera_info(camera_info_message(stamp_s))


def test_a_detection_is_placed_in_the_frame_of_the_depth_image(depth: DepthInput) -> None:
    fill(depth)
    image = placed(depth, 1.04)
    assert image is not None
    (box,) = image.placements
    assert isinstance(box, Box3D)
    assert np.linalg.norm(np.subtract(box.centre_xyz_m, SCENE.centre_xyz_m)) < 0.05 * SCENE.range_m
    assert (image.frame_id, image.distances_m) == (DEPTH_FRAME, [box.distance_m])
    assert depth.run is None
    assert counted(depth) == {"depth images received": 1, "images with depth": 1, "detections placed": 1}


def test_wrong_messages_are_rejected_with_the_reason_and_those_before_them_stay(depth: DepthInput) -> None:
    fill(depth)
    for why, changes in WRONG_DEPTHS.items():
        message = depth_message(PIXELS, 1.0)
        for name, value in changes.items():
            setattr(message, name, value)
        depth.take_image(message)
        assert why in depth.rejection
    for why, changes in WRONG_CAMERA_INFOS.items():
        depth.take_camera_info(camera_info_message(1.0, **changes))
        assert why in depth.rejection
    assert counted(depth) == {
        "depth images received": len(WRONG_DEPTHS) + 1,
        "depth images rejected": len(WRONG_DEPTHS),
        "camera_infos rejected": len(WRONG_CAMERA_INFOS),
    }
    assert placed(depth) is not None


@pytest.mark.parametrize(
    ("colour", "reason", "told"),
    [
        pytest.param({"stamp_s": 1.2}, Unplaced.NO_DEPTH_IMAGE, "older than the colour image", id="late"),
        pytest.param(
            {"size_hw": (48, 64)}, Unplaced.OTHER_SIZE, "images of 64x48, depth images of", id="size"
        ),
        pytest.param(
            {"frame_id": "colour"},
            Unplaced.OTHER_CAMERA,
            rf"the frame colour, depth images of {DEPTH_FRAME}; .* register_node.* one frame_id",
            id="camera",
        ),
    ],
)
def test_an_image_whose_detections_have_no_place_is_counted_with_the_reason(
    depth: DepthInput, colour: dict[str, Any], reason: Unplaced, told: str
) -> None:
    fill(depth)
    assert placed(depth, **colour) is None
    assert counted(depth) == {
        "depth images received": 1,
        "images without depth": 1,
        f"unplaced: {reason.value}": 1,
    }
    assert depth.run is not None
    assert re.search(told, depth.run.reason)


@pytest.mark.parametrize(
    "frames",
    [("", "camera"), ("camera", ""), ("/camera", "camera"), ("camera", "/camera")],
    ids=["only depth", "only colour", "colour as tf1 wrote it", "depth as tf1 wrote it"],
)
def test_frames_are_equal_where_one_is_missing_or_written_in_another_way(
    depth: DepthInput, frames: tuple[str, str]
) -> None:
    colour_frame, depth_frame = frames
    fill(depth)
    message = depth_message(SCENE.depth_m, 1.01)
    message.header.frame_id = depth_frame
    depth.take_image(message)
    image = placed(depth, 1.01, frame_id=colour_frame)
    assert image is not None
    assert image.frame_id == (depth_frame or colour_frame)


@pytest.mark.parametrize(
    ("topic", "lens"),
    [
        ("/camera/image_raw", "plumb_bob"),
        ("/of_rect/direct", "plumb_bob"),
        ("/camera/image_rect_raw", "rectified"),
    ],
)
def test_the_lens_counts_unless_the_topic_says_that_its_images_are_rectified(
    ros_domain: int, topic: str, lens: str
) -> None:
    with lone_node("yolov5", "-r", f"~/depth/image_raw:={topic}") as node:
        depth = DepthInput(node, slop_s=0.05)
        fill(depth)
        plain = placed(depth)
        depth.take_camera_info(
            camera_info_message(1.0, distortion_model="plumb_bob", d=[-0.3, 0.1, 0.0, 0.0])
        )
        seen = placed(depth)
        assert depth.values()["depth lens"] == lens
        assert plain is not None
        assert seen is not None
        assert (seen.placements == plain.placements) == (lens == "rectified")


def test_a_detection_without_measurements_is_counted_alone(depth: DepthInput) -> None:
    fill(depth)
    depth.take_image(depth_message(np.full_like(SCENE.depth_m, np.nan), 1.01, encoding="32FC1"))
    image = placed(depth, 1.01)
    assert image is not None
    assert (image.placements, image.frame_id) == ((Unplaced.NO_VALID_DEPTH,), DEPTH_FRAME)
    assert image.distances_m == [None]
    assert counted(depth) == {
        "depth images received": 2,
        "images with depth": 1,
        "unplaced: no valid depth in box": 1,
    }
    assert depth.run is not None
    assert depth.run.reason.startswith("nothing is measured anywhere in the depth images")
    depth.take_image(depth_message(SCENE.depth_m, 1.02))
    assert placed(depth, 1.02) is not None
    assert depth.run is None


@pytest.mark.parametrize(
    ("messages", "told"),
    [
        pytest.param([], "none has arrived on /yolov5/depth/camera_info; it must be published", id="none"),
        pytest.param([{"k": [0.0] * 9}], "camera_info is rejected: Expected intrinsics", id="rejected"),
        pytest.param(
            [{"height": 1000}],
            "camera_info of 320x1000 pixels; send the camera_info of the depth images: one with binning",
            id="of the whole sensor",
        ),
    ],
)
def test_what_is_wrong_with_the_camera_info_is_told_for_as_long_as_it_is(
    depth: DepthInput, messages: list[dict[str, Any]], told: str
) -> None:
    depth.take_image(depth_message(SCENE.depth_m, 1.0))
    for changes in messages:
        depth.take_camera_info(camera_info_message(1.0, **changes))
    assert placed(depth) is None
    assert depth.run is not None
    assert told in depth.run.reason


def test_each_camera_logs_why_its_depth_is_rejected(
    ros_domain: int, capfd: pytest.CaptureFixture[str]
) -> None:
    with lone_node("yolov5") as node:
        for camera in ("front", "rear"):
            depth = DepthInput(node, camera=camera, slop_s=0.05)
            for _ in range(3):
                depth.take_image(depth_message(PIXELS, 1.0, encoding="rgb8"))
    told = re.findall("(front|rear): depth images are rejected", capfd.readouterr().err)
    assert told == ["front", "rear"]


def test_a_run_of_images_without_depth_lasts_until_one_has_depth(ros_domain: int) -> None:
    times_s = iter((5.0, 6.0, 9.0))
    with lone_node("yolov5") as node:
        depth = DepthInput(node, slop_s=0.05, clock=lambda: next(times_s))
        for _ in range(3):
            placed(depth)
        assert depth.run is not None
        assert (depth.run.begun_s, depth.run.ended_s) == (5.0, 9.0)
        fill(depth)
        assert placed(depth) is not None
        assert depth.run is None


def test_what_was_received_before_is_forgotten(depth: DepthInput) -> None:
    depth.follow(is_needed=True)
    fill(depth)
    depth.take_camera_info(camera_info_message(1.0, k=[0.0] * 9))
    depth.follow(is_needed=False)
    assert placed(depth) is None
    assert counted(depth)["unplaced: no depth image"] == 1
    depth.take_image(depth_message(SCENE.depth_m, 1.0))
    assert placed(depth) is None
    assert counted(depth)["unplaced: no camera_info"] == 1
    assert depth.run is not None
    assert "none has arrived" in depth.run.reason


# The node


@pytest.fixture
def client(prepare: Preparations) -> Iterator[DepthClient]:
    with ServedNode(prepare, parameters=["depth:=true"]) as served:
        yield DepthClient(served)


def begin(client: DepthClient) -> None:
    client.served.bring_to("active")
    client.wait_for_depth()


def test_detections_are_placed_and_an_image_without_objects_has_an_empty_array(
    client: DepthClient, prepare: Preparations
) -> None:
    begin(client)
    array = client.place()
    plain = client.detections_of(client.detections[-1].header)
    assert array.header.frame_id == plain.header.frame_id == "_optical"
    assert len(array.detections) == len(plain.detections) == 1
    status = client.served.status()
    assert status.message == "detecting"
    values = {item.key: item.value for item in status.values}
    assert int(values["detections placed"]) >= 1
    assert int(values["images with depth"]) >= 1
    prepare.running.run = lambda: np.zeros((1, 7), np.float32)
    assert client.place().detections == []


def test_each_published_detection_is_placed_by_its_own_mask_although_something_beside_it_is_nearer(
    prepare: Preparations,
) -> None:
    """First the tracker looks at a cat, too, that is not published."""
    model = SegmentingModel(prepare)
    parameters = [*PARAMETERS, "depth:=true", "tracker:=bytetrack", "class_thresholds:=['cat: 0.95']"]
    with ServedNode(prepare, parameters=parameters) as served:
        camera = DepthClient(served, wall_m=4.0, size_hw=SIZE_HW)
        begin(camera)
        camera.depth_m[64:88, 32:112] = 3
        camera.depth_m[32:64, 40:64] = 1
        camera.depth_m[32:88, 16:40] = 2
        (dog,) = camera.place().detections
        assert dog.bbox.center.position.z == pytest.approx(3)
        assert served.set(class_thresholds=[]) == (True, "")
        cat, _ = camera.place().detections
        assert cat.bbox.center.position.z == pytest.approx(2)
        assert served.set(depth=False) == (True, "")
        computed = model.computed
        camera.see()
        assert model.computed == computed, "nobody needs masks"


def test_a_slow_model_places_detections_with_the_depth_image_of_their_moment(
    client: DepthClient, prepare: Preparations
) -> None:
    begin(client)
    client.place()
    gate = Gate()
    prepare.running.run = gate.before(lambda: prediction("cat", 0.9))
    received = int(client.served.values()["depth images received"])
    client.send_depth()

    def are_received(count: int) -> bool:
        return int(client.served.values()["depth images received"]) >= received + count

    client.served.wait_for(lambda: are_received(1), "the depth image")
    shown = client.send()
    client.served.wait_for(gate.reached.is_set, "inference to begin")
    client.depth_m[:] = 0
    for number in range(2, CAPACITY + 3):
        client.depth.publish(depth_message(client.depth_m, client.sent + number))
        client.served.wait_for(lambda: are_received(number), "the depth image")  # noqa: B023
    gate.open()
    client.served.wait_for(lambda: client.placed[-1].header.stamp == shown.stamp, "its place")
    assert len(client.placed[-1].detections) == 1


def test_a_lazy_node_needs_depth_only_for_those_who_show_it(client: DepthClient) -> None:
    begin(client)
    served = client.served
    served.ignore_detections()
    served.wait_for(lambda: served.image_subscriptions() == 1, "the node to stay subscribed")
    client.wait_for_depth()
    served.client.destroy_subscription(client.subscription)
    client.wait_for_depth(0)
    served.wait_for(lambda: served.image_subscriptions() == 0, "the node to unsubscribe")
    served.client.create_subscription(Image, "/yolov5/image", lambda _: None, 1)
    client.wait_for_depth()
    assert served.transition("deactivate")
    client.wait_for_depth(0)


def test_a_camera_info_that_was_latched_before_the_node_subscribed_is_used(client: DepthClient) -> None:
    node, topic = client.served.client, "/yolov5/depth/camera_info"
    node.destroy_publisher(client.info)
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    client.info = node.create_publisher(CameraInfo, topic, latched)
    height, width = client.size_hw
    client.info.publish(camera_info_message(1.0, height=height, width=width))
    begin(client)
    assert len(client.place(with_info=False).detections) == 1
    volatile = node.create_publisher(CameraInfo, topic, 2)
    client.served.wait_for(lambda: volatile.get_subscription_count() == 1, "a subscription that matches both")
    (subscription,) = node.get_subscriptions_info_by_topic("/yolov5/depth/image_raw")
    assert subscription.qos_profile.reliability.name == "BEST_EFFORT", "as the publisher offers"
