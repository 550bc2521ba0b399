"""Masks and annotated images, raw and compressed, are published for those who subscribe to them."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from numpy.typing import NDArray
from rclpy.lifecycle import LifecyclePublisher
from sensor_msgs.msg import CompressedImage
from std_msgs.msg import Header
from support.camera_client import CameraClient, DepthClient, Viewer
from support.gate import Gate
from support.preparations import CLASS_NAMES, Preparations, prediction
from support.segmented_scene import (
    CAT_XYXY,
    DOG_XYXY,
    PARAMETERS,
    SIZE_HW,
    MasksSubscriber,
    SegmentingModel,
    labels,
    pixels,
    rows,
)
from support.served_node import ServedNode, class_ids_of, image

from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.detection.draw import annotate
from yolov5_lifecycle.images.image import ColourImage, ImageError
from yolov5_lifecycle.ros.detector import pipeline
from yolov5_lifecycle.ros.messages import image_of_message
from yolov5_lifecycle.ros.topics import LABEL_INFO, full_name, published

# Annotated images


@pytest.mark.parametrize("channel_order", ["rgb", "bgr"])
def test_an_image_is_drawn_in_both_forms_with_its_header_and_colours(
    active: ServedNode, channel_order: str
) -> None:
    camera = CameraClient(active)
    raw, compressed = Viewer(camera), Viewer(camera, "image/compressed", CompressedImage)
    raw.begin()
    compressed.begin()
    colour = (10, 120, 240)
    shown = image(encoding=f"{channel_order}8")
    shown.data[:] = type(shown.data)("B", bytes(colour) * (len(shown.data) // 3))
    array = camera.see(shown)
    drawn, jpeg = raw.of(array.header), compressed.of(array.header)
    assert (drawn.encoding, jpeg.format) == (f"{channel_order}8", f"{channel_order}8; jpeg compressed bgr8")
    assert image_of_message(drawn).pixels[40, 40].tolist() == list(colour)
    in_bgr = colour if channel_order == "bgr" else colour[::-1]
    np.testing.assert_allclose(image_of_message(jpeg).pixels[40, 40].astype(int), in_bgr, atol=5)


def test_only_images_with_subscribers_are_encoded_and_one_that_cannot_be_leaves_the_raw_one(
    served: ServedNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    encoded: list[ColourImage] = []

    def refuse(image: ColourImage) -> NDArray[np.uint8]:
        encoded.append(image)
        raise ImageError("no room")

    monkeypatch.setattr(pipeline, "encode_jpeg", refuse)
    served.bring_to("active")
    camera = CameraClient(served)
    raw = Viewer(camera)
    raw.begin()
    raw.of(camera.see().header)
    assert not encoded
    Viewer(camera, "image/compressed", CompressedImage)
    served.wait_for(lambda: bool(camera.detect()) and bool(encoded), "an attempt")
    served.wait_for_log("no image on ~/image/compressed: no room")
    raw.of(camera.see().header)
    assert served.counts()["failed"] == 0


def test_ids_and_distances_are_drawn_although_nobody_asks_for_detections_in_space(
    prepare: Preparations,
) -> None:
    parameters = ["image_size:=320", "depth:=true", "tracker:=bytetrack", "track_timeout:=60.0"]
    with ServedNode(prepare, parameters=parameters) as served:
        served.bring_to("active")
        camera = DepthClient(served, size_hw=(240, 320))
        viewer = Viewer(camera)
        viewer.begin()
        camera.track()

        def seen(header: Header) -> NDArray[np.uint8]:
            return image_of_message(viewer.of(header)).pixels

        stamp = camera.place().header.stamp
        with_distance = seen(next(one.header for one in camera.detections if one.header.stamp == stamp))
        without_distance = seen(camera.see().header)  # without a depth image of its time
        assert (with_distance != without_distance).any()
        served.client.destroy_subscription(camera.subscription)

        def is_shown() -> bool:
            camera.send_depth()
            return bool((seen(camera.see().header) == with_distance).all())

        served.wait_for(is_shown, "a distance in the image")
        assert served.set(tracker="none") == (True, "")
        assert (seen(camera.see().header) != without_distance).any(), "without an id"


# Masks


@pytest.fixture
def model(prepare: Preparations) -> SegmentingModel:
    return SegmentingModel(prepare)


@pytest.fixture
def camera(prepare: Preparations, model: SegmentingModel) -> Iterator[CameraClient]:
    """Of an active node whose model segments."""
    with ServedNode(prepare, parameters=PARAMETERS) as served:
        served.bring_to("active")
        yield CameraClient(served, size_hw=SIZE_HW)


@pytest.fixture
def masks(camera: CameraClient) -> MasksSubscriber:
    """A subscriber that the node has discovered."""
    masks = MasksSubscriber(camera)
    masks.begin()
    return masks


def test_masks_number_the_detections_with_the_same_stamp(
    prepare: Preparations, masks: MasksSubscriber, model: SegmentingModel
) -> None:
    array, message = masks.segment()
    assert class_ids_of(array) == ["cat", "dog"]
    assert (message.header, message.encoding) == (array.header, "16UC1")
    np.testing.assert_array_equal(pixels(message), labels())
    prepare.running.run = rows
    computed = model.computed
    array, message = masks.segment()
    assert array.detections == []
    np.testing.assert_array_equal(pixels(message), np.zeros(SIZE_HW))
    assert model.computed == computed, "no prototypes are needed for that"


def test_an_image_that_is_detected_before_a_subscriber_joins_has_no_masks(
    camera: CameraClient, prepare: Preparations, model: SegmentingModel
) -> None:
    served, gate = camera.served, Gate()
    prepare.running.run = gate.before(lambda: rows(0.9, 0.8))
    served.wait_for(lambda: bool(camera.images.get_subscription_count()), "the node to subscribe")
    early = camera.send()
    served.wait_for(gate.reached.is_set, "inference to begin")
    masks, viewer = MasksSubscriber(camera), Viewer(camera)
    topics = ("/yolov5/masks", "/yolov5/image")
    served.wait_for(lambda: all(map(served.node.count_subscribers, topics)), "the subscribers")
    gate.open()
    assert class_ids_of(camera.detections_of(early)) == ["cat", "dog"]
    assert model.computed == 0
    masks.begin()
    viewer.of(camera.see().header)
    assert early not in [message.header for message in masks.received]
    assert served.counts()["failed"] == 0


def test_the_annotated_image_shows_masks_translucent(camera: CameraClient, model: SegmentingModel) -> None:
    viewer = Viewer(camera)
    viewer.begin()
    assert model.computed > 0
    seen = image_of_message(viewer.of(camera.see().header)).pixels
    grey = ColourImage(np.full((*SIZE_HW, 3), 114, np.uint8), "rgb")
    found = Detections(
        np.array([CAT_XYXY, DOG_XYXY], np.float32), np.array([0.9, 0.8], np.float32), np.array([0, 1])
    )
    np.testing.assert_array_equal(seen, annotate(grey, found, CLASS_NAMES, label_image=labels()))
    assert (seen != annotate(grey, found, CLASS_NAMES)).any()


def test_masks_fit_the_detections_that_the_tracker_leaves(
    prepare: Preparations, masks: MasksSubscriber, camera: CameraClient
) -> None:
    assert camera.served.set(tracker="bytetrack", track_timeout=60.0) == (True, "")
    camera.served.wait_for(lambda: all(one.id for one in masks.segment()[0].detections), "tracks")
    array, message = masks.segment()
    assert [detection.id for detection in array.detections] == ["1", "2"]
    np.testing.assert_array_equal(pixels(message), labels())
    prepare.running.run = lambda: rows(0.9, 0.15)  # continues a track, but is not published
    array, message = masks.segment()
    assert [detection.id for detection in array.detections] == ["1"]
    np.testing.assert_array_equal(pixels(message), np.where(labels() == 1, 1, 0))


def test_a_subscriber_to_masks_alone_does_not_keep_a_model_detecting_that_does_not_segment(
    active: ServedNode, prepare: Preparations
) -> None:
    camera = CameraClient(active, size_hw=SIZE_HW)
    masks, told = MasksSubscriber(camera), "~/masks has a subscriber, but the loaded model does not segment"
    active.wait_for(lambda: bool(camera.detect()) and told in active.status().message, "the remark")
    assert "masks" not in active.values()
    assert masks.received == []
    active.ignore_detections()
    active.wait_for(lambda: active.image_subscriptions() == 0, "the node to unsubscribe")
    SegmentingModel(prepare)
    assert active.set(image_size=128) == (True, "")
    active.wait_for(lambda: bool(camera.send()) and bool(masks.received), "masks")
    np.testing.assert_array_equal(pixels(masks.received[0]), labels())
    assert active.values()["masks"] == "2 coefficients"
    prepare.mask_coefficients, prepare.compute_prototypes = 0, None
    prepare.run = lambda: prediction("cat", 0.9)
    assert active.set(image_size=64) == (True, "")
    active.wait_for(lambda: active.image_subscriptions() == 0, "the node to unsubscribe")


# All topics


def test_a_subscriber_to_any_topic_keeps_a_lazy_node_detecting(prepare: Preparations) -> None:
    SegmentingModel(prepare)
    arguments = ["--ros-args", "-r", "~/image:=/screen"]
    with ServedNode(prepare, parameters=[*PARAMETERS, "depth:=true"], arguments=arguments) as served:
        served.bring_to("active")
        served.ignore_detections()
        outputs = [each for each in served.node.publishers if isinstance(each, LifecyclePublisher)]
        names = [each.topic_name for each in outputs]
        assert sorted(names) == sorted(full_name(served.node, topic) for topic in published(("",)))
        assert "/screen/compressed" in names, "as image_transport names it"
        for output in outputs:
            if output.topic_name == full_name(served.node, LABEL_INFO):
                continue  # published once, without images
            served.wait_for(lambda: served.image_subscriptions() == 0, "the node to unsubscribe")
            viewer = served.client.create_subscription(output.msg_type, output.topic_name, lambda _: None, 1)
            served.wait_for(lambda: served.image_subscriptions() == 1, output.topic_name)
            served.client.destroy_subscription(viewer)
