"""Points of the detected objects, as a subscriber and as Nav2's costmap receive them."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from numpy.typing import NDArray
from sensor_msgs.msg import PointCloud2
from support.camera_client import DepthClient, Viewer
from support.depth_scene import CAMERA, rays, tight_box
from support.floor_scene import View, rendered, room
from support.point_clouds import Costmap, points_of
from support.preparations import Preparations, prediction
from support.segmented_scene import PARAMETERS, SIZE_HW, SegmentingModel
from support.served_node import ServedNode
from support.solids import Cuboid

VIEW = View(height_m=1.5, pitch=0.0, x_m=0.0, z_m=4.0, yaw=0.0)
CRATE_M = rendered(VIEW, (Cuboid((-0.25, 0, -0.2), (0.25, 0.6, 0.2)),))
ROOM_M = room(VIEW, wall_m=2.0)
LETTERBOX_PX = 8
"""Above the image of 320x240 pixels in the input of the network."""


def crate() -> NDArray[np.float32]:
    """The raw prediction of a cat where the crate is."""
    x1, y1, x2, y2 = tight_box(np.isfinite(CRATE_M))
    row = prediction("cat", 0.9)
    row[0, :4] = (x1 + x2) / 2, (y1 + y2) / 2 + LETTERBOX_PX, x2 - x1, y2 - y1
    return row


@pytest.fixture
def camera(prepare: Preparations) -> Iterator[DepthClient]:
    """Of an active node that needs places in space for the points only."""
    prepare.run = crate
    with ServedNode(prepare, parameters=["depth:=true", "image_size:=320"]) as served:
        camera = DepthClient(served, size_hw=CAMERA.size_hw)
        served.client.destroy_subscription(camera.subscription)
        camera.depth_m = np.minimum(CRATE_M, ROOM_M).astype(np.float32)
        served.bring_to("active")
        yield camera


@pytest.fixture
def clouds(camera: DepthClient) -> Viewer:
    viewer = Viewer(camera, "points", PointCloud2)
    camera.wait_for_depth()
    return viewer


def cloud_of(camera: DepthClient, clouds: Viewer) -> PointCloud2:
    """That of the next image with depth."""
    stamp = camera.sent + 1

    def is_newer() -> bool:
        camera.send_depth()
        camera.detect()
        return bool(clouds.received) and int(clouds.received[-1].header.stamp.sec) >= stamp

    camera.served.wait_for(is_newer, "points of the present scene")
    cloud: PointCloud2 = clouds.received[-1]
    return cloud


def test_points_name_their_detection_and_an_image_without_objects_has_an_empty_cloud(
    camera: DepthClient, clouds: Viewer, prepare: Preparations
) -> None:
    cloud = cloud_of(camera, clouds)
    assert cloud.header.frame_id == "_optical"
    values = points_of(cloud)
    assert len(values) > 500
    assert {*values["detection"]} == {*values["class_id"]} == {0}
    assert values["score"][0] == pytest.approx(0.9)
    assert values["z"].min() == pytest.approx(3.8, abs=0.01)
    prepare.running.run = lambda: np.zeros((1, 7), np.float32)
    empty = cloud_of(camera, clouds)
    assert (empty.width, len(empty.data), len(empty.fields)) == (0, 0, 7)


def test_classes_and_spacing_of_the_points_change_live(camera: DepthClient, clouds: Viewer) -> None:
    fine = cloud_of(camera, clouds).width
    assert camera.served.set(points_spacing_m=0.1) == (True, "")
    assert 0 < cloud_of(camera, clouds).width < 0.6 * fine
    assert camera.served.set(points_classes=["dog"]) == (True, "")
    assert cloud_of(camera, clouds).width == 0
    is_set, why = camera.served.set(points_classes=["dgo"])
    assert not is_set
    assert "points_classes: 'dgo' is not a class of the model (cat, dog). Did you mean 'dog'?" in why


def test_of_the_chosen_classes_each_point_is_in_the_mask_of_its_own_detection(prepare: Preparations) -> None:
    """Of the second detection; the first one's mask, the left third of its box, has what is nearer."""
    SegmentingModel(prepare)
    parameters = [*PARAMETERS, "depth:=true", "points_classes:=[dog]", "points_spacing_m:=0.0"]
    with ServedNode(prepare, parameters=parameters) as served:
        camera = DepthClient(served, wall_m=4.0, size_hw=SIZE_HW)
        served.client.destroy_subscription(camera.subscription)
        camera.depth_m[64:88, 32:112] = 3
        camera.depth_m[64:88, 32:40] = 2
        clouds = Viewer(camera, "points", PointCloud2)
        served.bring_to("active")
        camera.wait_for_depth()
        values = points_of(cloud_of(camera, clouds))
        assert {*values["detection"]} == {*values["class_id"]} == {1}
        np.testing.assert_allclose(values["z"], 3, rtol=1e-6)
        assert len(values) == pytest.approx(24 * 72, rel=0.1)


def test_a_lazy_node_without_depth_detects_nothing_for_points(prepare: Preparations) -> None:
    with ServedNode(prepare) as served:
        served.ignore_detections()
        served.bring_to("active")
        served.client.create_subscription(PointCloud2, "/yolov5/points", lambda _: None, 1)
        told = "~/points has a subscriber, but nothing is published on it: set depth to true"
        served.wait_for(lambda: served.status().message == told, "the remark")
        assert served.image_subscriptions() == 0


def test_a_costmap_marks_the_object_alone_and_is_cleared_when_it_has_gone(
    camera: DepthClient, clouds: Viewer, prepare: Preparations
) -> None:
    """The whole depth image clears, as docs/points.md has it."""
    costmap = Costmap(camera_height_m=VIEW.height_m)
    directions = np.stack(rays(), axis=-1)[::8, ::2].reshape(-1, 3)

    def update() -> NDArray[np.bool_]:
        depth_m = camera.depth_m[::8, ::2].reshape(-1, 1)
        costmap.update(cloud_of(camera, clouds), directions * depth_m)
        return costmap.is_marked

    ahead, left = np.nonzero(update())
    assert (ahead.min(), ahead.max()) == pytest.approx((76, 83), abs=1), "3.8 to 4.2 m"
    assert (left.min(), left.max()) == (95, 104), "half a metre wide"
    prepare.running.run = lambda: np.zeros((1, 7), np.float32)
    camera.depth_m = ROOM_M.astype(np.float32)
    assert not update().any()
