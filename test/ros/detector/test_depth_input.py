"""Depth images and camera_info in, places of detections out: what is rejected, and why there is no place."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from rclpy.node import Node
from support.depth_messages import DEPTH_FRAME, camera_info_message, depth_message, header
from support.depth_scene import CAMERA, random_depth_scene
from support.hostile_depth import hostile_camera_infos, hostile_depths
from support.lone_node import lone_node

from yolov5_lifecycle.ros.detector.depth import DepthInput, PlacedImage
from yolov5_lifecycle.spatial.placement import Box3D, Unplaced

SCENE = random_depth_scene(np.random.default_rng(5), "board")
BOXES = SCENE.box_xyxy[None]
BLIND = np.full(CAMERA.size_hw, np.nan, np.float32)


@pytest.fixture
def node(ros_domain: int) -> Iterator[Node]:
    with lone_node("yolov5") as node:
        yield node


@pytest.fixture
def depth(node: Node) -> DepthInput:
    return DepthInput(node, slop_s=0.05)


def placed(
    depth: DepthInput, stamp_s: float = 1.0, size_hw: tuple[int, int] = CAMERA.size_hw
) -> PlacedImage | None:
    return depth.place(BOXES, size_hw, header(stamp_s).stamp)


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
    assert (depth.counts.placed, depth.counts.placed_images, depth.run) == (1, 1, None)


@pytest.mark.parametrize("why", hostile_depths())
def test_a_hostile_depth_image_is_rejected_and_those_before_it_stay(depth: DepthInput, why: str) -> None:
    fill(depth)
    depth.take_image(hostile_depths()[why])
    assert (depth.counts.depth_images, depth.counts.rejected_depth_images) == (2, 1)
    assert why in depth.status().recently_rejected
    assert placed(depth) is not None


@pytest.mark.parametrize("why", hostile_camera_infos())
def test_a_hostile_camera_info_is_rejected_and_the_one_before_it_stays(depth: DepthInput, why: str) -> None:
    fill(depth)
    depth.take_camera_info(hostile_camera_infos()[why])
    assert depth.counts.rejected_camera_infos == 1
    assert why in depth.status().recently_rejected
    assert placed(depth) is not None


@pytest.mark.parametrize(
    ("stamp_s", "size_hw", "reason", "told"),
    [
        pytest.param(1.2, CAMERA.size_hw, Unplaced.NO_DEPTH_IMAGE, "older than the colour image", id="late"),
        pytest.param(0.8, CAMERA.size_hw, Unplaced.NO_DEPTH_IMAGE, "no longer kept", id="passed"),
        pytest.param(1.0, (48, 64), Unplaced.OTHER_SIZE, "images of 64x48, depth images of", id="size"),
    ],
)
def test_an_image_whose_detections_have_no_place_is_counted_with_the_reason(
    depth: DepthInput, stamp_s: float, size_hw: tuple[int, int], reason: Unplaced, told: str
) -> None:
    fill(depth)
    assert placed(depth, stamp_s, size_hw) is None
    assert depth.counts.unplaced == {reason: 1}
    assert depth.counts.unplaced_images == 1
    assert depth.run is not None
    assert told in depth.run.reason


def test_depth_without_camera_info_places_nothing(depth: DepthInput) -> None:
    depth.take_image(depth_message(SCENE.depth_m, 1.0))
    assert placed(depth) is None


def test_a_detection_without_measurements_is_counted_alone(depth: DepthInput) -> None:
    fill(depth)
    depth.take_image(depth_message(BLIND, 1.01, encoding="32FC1"))
    image = placed(depth, 1.01)
    assert image == PlacedImage((Unplaced.NO_VALID_DEPTH,), DEPTH_FRAME)
    assert image is not None
    assert image.distances_m == [None]
    assert depth.counts.unplaced == {Unplaced.NO_VALID_DEPTH: 1}
    assert (depth.counts.placed, depth.counts.placed_images) == (0, 1)


def test_a_run_of_images_without_depth_lasts_until_one_has_depth(node: Node) -> None:
    times_s = iter((5.0, 6.0, 9.0))
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
    depth.follow(is_needed=False)
    assert placed(depth) is None
    assert depth.counts.unplaced == {Unplaced.NO_DEPTH_IMAGE: 1}
