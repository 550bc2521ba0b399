"""Annotated images, raw and compressed, are published for those who subscribe to them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import closing
from typing import Any

import numpy as np
import pytest
import rclpy
from numpy.typing import NDArray
from rclpy.lifecycle import LifecycleNode
from rclpy.subscription import Subscription
from sensor_msgs.msg import CompressedImage, Image
from std_msgs.msg import Header

from yolov5_lifecycle.images.compressed import encode_jpeg
from yolov5_lifecycle.images.image import ColourImage, ImageError, Order
from yolov5_lifecycle.ros.detector.outputs import Outputs
from yolov5_lifecycle.ros.messages import image_of_message
from yolov5_lifecycle.ros.observer import Observer

HEADER = Header(frame_id="lens")
PIXELS = np.full((48, 64, 3), (10, 120, 240), np.uint8)


@pytest.fixture
def node(ros_domain: int) -> Iterator[LifecycleNode]:
    """An active lifecycle node of the detector's name."""
    context = rclpy.Context()
    rclpy.init(context=context, args=[])
    node = LifecycleNode("yolov5", context=context)
    node.trigger_configure()
    yield node
    node.destroy_node()
    rclpy.shutdown(context=context)


@pytest.fixture
def observer(ros_domain: int) -> Iterator[Observer]:
    with closing(Observer("subscriber", domain=ros_domain)) as observer:
        yield observer


def made(node: LifecycleNode, encode: Callable[[ColourImage], NDArray[np.uint8]] = encode_jpeg) -> Outputs:
    outputs = Outputs(node, on_subscribers_changed=lambda: None, encode=encode)
    node.trigger_activate()
    return outputs


def publish_until(
    outputs: Outputs, image: ColourImage, observer: Observer, received: Callable[[], bool]
) -> None:
    """A subscriber may be discovered before it discovers the publisher, so once is not enough."""

    def is_received() -> bool:
        for send in outputs.image_messages(image, HEADER):
            send()
        return received()

    observer.wait_for(is_received, "the images")


def listen(observer: Observer, message_type: type, topic: str, received: list[Any]) -> Subscription:
    return observer.create_subscription(message_type, topic, received.append, 1)


@pytest.mark.parametrize("order", ["rgb", "bgr"])
def test_an_image_is_published_in_both_forms_with_its_header_and_colours(
    node: LifecycleNode, observer: Observer, order: Order
) -> None:
    raw: list[Image] = []
    compressed: list[CompressedImage] = []
    outputs = made(node)
    listen(observer, Image, "/yolov5/image", raw)
    listen(observer, CompressedImage, "/yolov5/image/compressed", compressed)
    observer.wait_for(lambda: outputs.image_subscribers == 2, "both subscribers")
    publish_until(outputs, ColourImage(PIXELS, order), observer, lambda: bool(raw and compressed))
    assert raw[0].header == compressed[0].header == HEADER
    assert compressed[0].format == f"{order}8; jpeg compressed bgr8"
    assert (raw[0].encoding, image_of_message(raw[0]).order) == (f"{order}8", order)
    np.testing.assert_array_equal(image_of_message(raw[0]).pixels, PIXELS)
    in_bgr = PIXELS if order == "bgr" else PIXELS[..., ::-1]
    np.testing.assert_allclose(image_of_message(compressed[0]).pixels.astype(int), in_bgr, atol=5)


def test_only_images_with_subscribers_are_encoded(node: LifecycleNode, observer: Observer) -> None:
    encoded: list[ColourImage] = []

    def encode(image: ColourImage) -> NDArray[np.uint8]:
        encoded.append(image)
        return encode_jpeg(image)

    raw: list[Image] = []
    outputs = made(node, encode)
    assert (outputs.subscribers, outputs.image_subscribers, outputs.mask_subscribers) == (0, 0, 0)
    listen(observer, Image, "/yolov5/image", raw)
    observer.wait_for(lambda: outputs.subscribers == 1, "a subscriber")
    publish_until(outputs, ColourImage(PIXELS, "rgb"), observer, lambda: bool(raw))
    assert not encoded


def test_an_image_that_cannot_be_compressed_is_still_published_raw(
    node: LifecycleNode, observer: Observer
) -> None:
    def encode(image: ColourImage) -> NDArray[np.uint8]:
        raise ImageError("no room")

    raw: list[Image] = []
    outputs = made(node, encode)
    listen(observer, Image, "/yolov5/image", raw)
    listen(observer, CompressedImage, "/yolov5/image/compressed", [])
    observer.wait_for(lambda: outputs.image_subscribers == 2, "both subscribers")
    publish_until(outputs, ColourImage(PIXELS, "rgb"), observer, lambda: bool(raw))


def test_the_compressed_topic_follows_the_remapped_raw_one(ros_domain: int) -> None:
    context = rclpy.Context()
    rclpy.init(context=context, args=["--ros-args", "-r", "~/image:=/screen"])
    node = LifecycleNode("yolov5", context=context)
    node.trigger_configure()
    outputs = made(node)
    assert {publisher.topic_name for publisher in node.publishers} >= {"/screen", "/screen/compressed"}
    outputs.close()
    assert not any(publisher.topic_name.startswith("/screen") for publisher in node.publishers)
    node.destroy_node()
    rclpy.shutdown(context=context)
