"""Several cameras on a model that segments: each has masks of its own, for those who ask."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from support.camera_client import CameraClient
from support.preparations import Preparations
from support.segmented_scene import (
    PARAMETERS,
    SIZE_HW,
    MasksSubscriber,
    SegmentingModel,
    labels,
    pixels,
)
from support.served_node import ServedNode, class_ids_of, image
from vision_msgs.msg import Detection2DArray


@pytest.fixture
def model(prepare: Preparations) -> SegmentingModel:
    return SegmentingModel(prepare)


@pytest.fixture
def served(prepare: Preparations, model: SegmentingModel) -> Iterator[ServedNode]:
    """An active node with two cameras."""
    with ServedNode(prepare, parameters=(*PARAMETERS, "cameras:=[front, rear]")) as served:
        served.bring_to("active")
        yield served
    assert served.escaped == []


@pytest.fixture
def front(served: ServedNode) -> CameraClient:
    return CameraClient(served, "front")


@pytest.fixture
def rear(served: ServedNode) -> CameraClient:
    return CameraClient(served, "rear")


def detect(camera: CameraClient) -> Detection2DArray:
    """What is found in the next image of the scene."""
    camera.wait_for(camera.send(image(*SIZE_HW)))
    return camera.detections[-1]


def begin(*cameras: CameraClient) -> None:
    """Wait until each camera is subscribed to."""
    for camera in cameras:
        camera.served.wait_for(lambda one=camera: one.images.get_subscription_count() == 1, "the node")  # type: ignore[misc]
        camera.detect()
        camera.wait_for(camera.send(image(*SIZE_HW)))


def masks_of(camera: CameraClient) -> MasksSubscriber:
    """A subscriber to the masks of `camera` that the node has discovered."""
    masks = MasksSubscriber(camera.served, camera.topic("masks"))

    def have_come() -> bool:
        detect(camera)
        return bool(masks.received)

    camera.served.wait_for(have_come, "masks")
    return masks


def test_each_camera_publishes_masks_of_its_own(
    served: ServedNode, front: CameraClient, rear: CameraClient, model: SegmentingModel
) -> None:
    begin(front, rear)
    of_front, of_rear = masks_of(front), masks_of(rear)
    for camera, masks in ((front, of_front), (rear, of_rear)):
        array = detect(camera)
        message = masks.of(array.header)
        assert message.header.frame_id == f"{camera.name}_optical"
        np.testing.assert_array_equal(pixels(message), labels())
    assert {one.header.frame_id for one in of_front.received} == {"front_optical"}
    assert {one.header.frame_id for one in of_rear.received} == {"rear_optical"}


def test_masks_are_computed_for_the_camera_alone_whose_masks_are_asked_for(
    front: CameraClient, rear: CameraClient, model: SegmentingModel
) -> None:
    begin(front, rear)
    masks = masks_of(front)
    before = model.computed
    assert class_ids_of(detect(rear)) == ["cat", "dog"]
    assert model.computed == before
    masks.of(detect(front).header)
    assert model.computed == before + 1


def test_a_model_that_does_not_segment_is_told_of_the_camera_whose_masks_are_asked_for(
    prepare: Preparations,
) -> None:
    with ServedNode(prepare, parameters=["cameras:=[front, rear]"]) as served:
        served.bring_to("active")
        masks = MasksSubscriber(served, "/yolov5/front/masks")

        def is_told() -> bool:
            return bool(served.statuses()["front"].message.startswith("~/front/masks has a subscriber, but"))

        served.wait_for(is_told, "the remark")
        assert "masks" not in served.statuses()["rear"].message
        assert served.statuses()["detection"].message == "detecting"
        assert masks.received == []
    assert served.escaped == []
