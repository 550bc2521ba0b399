"""Which pixels belong to which detection, for those who ask."""

from __future__ import annotations

import threading
from collections.abc import Iterator

import numpy as np
import pytest
from numpy.typing import NDArray
from rclpy.qos import QoSProfile
from sensor_msgs.msg import Image
from support.preparations import CLASS_NAMES, Preparations, prediction
from support.segmented_scene import (
    CAT_XYXY,
    DOG_XYXY,
    PARAMETERS,
    SIZE_HW,
    MasksSubscriber,
    SceneCamera,
    SegmentingModel,
    labels,
    pixels,
    rows,
)
from support.served_node import PATIENCE_S, ServedNode, class_ids_of, image

from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.detection.draw import annotate
from yolov5_lifecycle.images.image import ColourImage
from yolov5_lifecycle.ros.messages import image_of_message
from yolov5_lifecycle.runtimes.runtime import InferenceError

TOLD = (
    "~/masks has a subscriber, but the loaded model does not segment: load a segmentation model, such as "
    "yolov5n-seg.pt, with weights"
)


@pytest.fixture
def model(prepare: Preparations) -> SegmentingModel:
    return SegmentingModel(prepare)


@pytest.fixture
def served(prepare: Preparations, model: SegmentingModel) -> Iterator[ServedNode]:
    """An active node whose model segments."""
    with ServedNode(prepare, parameters=PARAMETERS) as served:
        served.bring_to("active")
        yield served
    assert served.escaped == []


@pytest.fixture
def camera(served: ServedNode) -> SceneCamera:
    return SceneCamera(served)


@pytest.fixture
def masks(served: ServedNode, camera: SceneCamera) -> MasksSubscriber:
    """A subscriber that the node has discovered."""
    masks = MasksSubscriber(served)
    camera.wait_for_masks(masks)
    return masks


def drop_detections(served: ServedNode) -> None:
    """Subscribe to detections no longer."""
    for subscription in list(served.client.subscriptions):
        if subscription.topic == "/yolov5/detections":
            served.client.destroy_subscription(subscription)


def test_masks_number_the_detections_with_the_same_stamp(camera: SceneCamera, masks: MasksSubscriber) -> None:
    array, message = camera.segment(masks)
    assert class_ids_of(array) == ["cat", "dog"]
    assert message.header == array.header
    assert (message.encoding, message.is_bigendian) == ("16UC1", 0)
    assert (message.height, message.width, message.step) == (*SIZE_HW, 2 * SIZE_HW[1])
    np.testing.assert_array_equal(pixels(message), labels())


def test_an_image_without_detections_has_empty_masks(
    prepare: Preparations, camera: SceneCamera, masks: MasksSubscriber, model: SegmentingModel
) -> None:
    prepare.running.run = rows
    computed = model.computed
    array, message = camera.segment(masks)
    assert array.detections == []
    np.testing.assert_array_equal(pixels(message), np.zeros(SIZE_HW))
    assert model.computed == computed, "no prototypes are needed for that"


def test_masks_are_computed_only_while_somebody_asks_for_them(
    served: ServedNode, camera: SceneCamera, model: SegmentingModel
) -> None:
    for _ in range(3):
        assert class_ids_of(camera.detect()) == ["cat", "dog"]
    assert model.computed == 0
    masks = MasksSubscriber(served)
    camera.wait_for_masks(masks)
    assert model.computed > 0
    masks.leave()

    def is_detected_without_masks() -> bool:
        before = model.computed
        camera.detect()
        return model.computed == before

    served.wait_for(is_detected_without_masks, "the node to compute no masks")


def test_a_subscriber_to_masks_alone_keeps_a_lazy_node_detecting(served: ServedNode) -> None:
    drop_detections(served)
    served.wait_for(lambda: served.image_subscriptions() == 0, "the node to unsubscribe")
    masks = MasksSubscriber(served)

    def are_received() -> bool:
        served.images.publish(image(*SIZE_HW))
        return bool(masks.received)

    served.wait_for(are_received, "masks")
    np.testing.assert_array_equal(pixels(masks.received[-1]), labels())
    masks.leave()
    served.wait_for(lambda: served.image_subscriptions() == 0, "the node to unsubscribe")


def test_an_image_that_is_detected_before_somebody_subscribes_has_no_masks(
    served: ServedNode, prepare: Preparations, camera: SceneCamera, model: SegmentingModel
) -> None:
    entered, release = threading.Event(), threading.Event()

    def wait() -> NDArray[np.float32]:
        entered.set()
        assert release.wait(PATIENCE_S)
        return rows(0.9, 0.8)

    prepare.running.run = wait
    early = camera.send()
    served.wait_for(entered.is_set, "inference to begin")
    masks, drawn = MasksSubscriber(served), list[Image]()
    served.client.create_subscription(Image, "/yolov5/image", drawn.append, QoSProfile(depth=10))
    for topic in ("/yolov5/masks", "/yolov5/image"):
        served.wait_for(
            lambda topic=topic: served.node.count_subscribers(topic) == 1,  # type: ignore[misc]
            "the subscriber",
        )
    release.set()
    assert class_ids_of(camera.detections(early)) == ["cat", "dog"]
    assert model.computed == 0
    camera.wait_for_masks(masks)
    served.wait_for(lambda: any(one.header.stamp.sec > early.stamp.sec for one in drawn), "the next image")
    assert early not in [message.header for message in masks.received]
    assert served.counts()["failed"] == 0


def test_the_annotated_image_shows_masks_translucent(
    served: ServedNode, camera: SceneCamera, model: SegmentingModel
) -> None:
    drawn: list[Image] = []
    served.client.create_subscription(Image, "/yolov5/image", drawn.append, QoSProfile(depth=10))

    def is_drawn() -> bool:
        camera.detect()
        return bool(drawn)

    served.wait_for(is_drawn, "an annotated image")
    assert model.computed > 0
    seen = image_of_message(drawn[-1]).pixels
    grey = ColourImage(np.full((*SIZE_HW, 3), 114, np.uint8), "rgb")
    found = Detections(
        np.array([CAT_XYXY, DOG_XYXY], np.float32), np.array([0.9, 0.8], np.float32), np.array([0, 1])
    )
    np.testing.assert_array_equal(seen, annotate(grey, found, CLASS_NAMES, label_image=labels()))
    assert (seen != annotate(grey, found, CLASS_NAMES)).any()


def test_masks_fit_the_detections_that_the_tracker_leaves(
    prepare: Preparations, model: SegmentingModel
) -> None:
    with ServedNode(prepare, parameters=(*PARAMETERS, "tracker:=bytetrack", "track_timeout:=60.0")) as served:
        served.bring_to("active")
        camera, masks = SceneCamera(served), MasksSubscriber(served)
        camera.wait_for_masks(masks)
        array, message = camera.segment(masks)
        assert [detection.id for detection in array.detections] == ["1", "2"]
        np.testing.assert_array_equal(pixels(message), labels())
        prepare.running.run = lambda: rows(0.9, 0.15)  # continues a track, but is not published
        array, message = camera.segment(masks)
        assert [detection.id for detection in array.detections] == ["1"]
        np.testing.assert_array_equal(pixels(message), np.where(labels() == 1, 1, 0))
    assert served.escaped == []


def test_masks_that_cannot_be_computed_are_a_failed_frame(
    served: ServedNode, prepare: Preparations, camera: SceneCamera, masks: MasksSubscriber
) -> None:
    compute = prepare.running.compute_prototypes

    def fail() -> NDArray[np.float32]:
        raise InferenceError("the device is on fire")

    prepare.running.compute_prototypes = fail
    lost = camera.send()
    served.wait_for(lambda: served.counts()["failed"] == 1, "the failure")
    served.wait_for_log("inference failed: InferenceError: the device is on fire")
    counts = served.counts()
    assert counts["detected"] == counts["received"] - 1
    prepare.running.compute_prototypes = compute
    camera.segment(masks)
    assert lost not in [message.header for message in (*served.detections, *masks.received)]
    assert served.state() == "active"


def test_a_model_that_does_not_segment_is_told_until_another_is_loaded(prepare: Preparations) -> None:
    """A subscriber to masks alone does not keep such a model detecting."""
    with ServedNode(prepare, parameters=("image_size:=64",)) as served:
        served.bring_to("active")
        camera, masks = SceneCamera(served), MasksSubscriber(served)

        def is_told() -> bool:
            assert class_ids_of(camera.detect()) == ["cat"]
            return bool(served.status().message == TOLD)

        served.wait_for(is_told, "the remark")
        assert "masks" not in served.values()
        assert masks.received == []
        drop_detections(served)
        served.wait_for(lambda: served.image_subscriptions() == 0, "the node to unsubscribe")
        assert served.status().message == TOLD
        SegmentingModel(prepare)
        assert served.set(image_size=128) == (True, "")
        served.wait_for(lambda: served.image_subscriptions() == 1, "the node to subscribe")

        def are_received() -> bool:
            camera.send()  # again, as the first image after another subscription may be lost
            return bool(masks.received)

        served.wait_for(are_received, "masks")
        np.testing.assert_array_equal(pixels(masks.received[0]), labels())
        status = served.status()
        assert status.message == "detecting"
        assert "2 coefficients" in {item.value for item in status.values if item.key == "masks"}
        served.wait_for_log("the model was replaced: weights /scripted.pt")
        assert any("masks 2 coefficients" in said for said in served.log)
        prepare.mask_coefficients, prepare.compute_prototypes = 0, None
        prepare.run = lambda: prediction("cat", 0.9)
        assert served.set(image_size=64) == (True, "")
        served.wait_for(lambda: served.image_subscriptions() == 0, "the node to unsubscribe")
    assert served.escaped == []
