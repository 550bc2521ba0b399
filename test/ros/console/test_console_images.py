"""Images reach viewers as they take them, the newest only, and nobody receives them without a viewer."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from sensor_msgs.msg import Image
from support.console_fixtures import ConsoleBesideNode, JpegPublisher, console_beside_node
from support.detector_process import NODE
from support.preparations import Preparations
from support.served_node import ServedNode, image
from websockets.exceptions import ConnectionClosed

LARGE = 200_000
"""Bytes of an image that the buffers of a connection do not swallow many times."""


@pytest.fixture(scope="module")
def console() -> Iterator[ConsoleBesideNode]:
    with console_beside_node() as beside, beside.client.page() as page:
        page.wait_for(lambda: NODE in page.nodes, "the detector")
        yield beside


@pytest.fixture
def images(console: ConsoleBesideNode) -> Iterator[JpegPublisher]:
    """The annotated images of the detector, which is unconfigured and so publishes none itself."""
    publisher = JpegPublisher(console.served.client, f"{NODE}/image/compressed")
    yield publisher
    wait_for_subscribers(console, publisher, 0)  # else the next test takes a leaving one for its own
    publisher.close()


def wait_for_subscribers(console: ConsoleBesideNode, images: JpegPublisher, count: int) -> None:
    console.served.wait_for(lambda: images.subscribers == count, f"{count} subscribers")


@pytest.mark.long
def test_the_images_are_subscribed_to_while_there_is_a_viewer(
    console: ConsoleBesideNode, images: JpegPublisher
) -> None:
    assert images.subscribers == 0
    with console.client.viewer():
        wait_for_subscribers(console, images, 1)
        with console.client.viewer():
            pass
        with console.client.page() as page:
            page.wait_for(lambda: NODE in page.nodes, "the detector")
        assert images.subscribers == 1
    wait_for_subscribers(console, images, 0)


def test_a_viewer_receives_stamp_and_image_as_they_are(
    console: ConsoleBesideNode, images: JpegPublisher
) -> None:
    with console.client.viewer() as viewer:
        wait_for_subscribers(console, images, 1)
        images.publish(1234)
        assert viewer.receive() == (1.0, bytes(1234))


def test_a_viewer_that_has_not_taken_an_image_gets_only_the_newest_one_after_that(
    console: ConsoleBesideNode, images: JpegPublisher
) -> None:
    with console.client.viewer() as slow, console.client.viewer() as quick:
        wait_for_subscribers(console, images, 1)
        images.publish()
        assert slow.receive()[0] == quick.receive()[0] == 1.0
        for number in range(2, 12):
            quick.take()
            images.publish()
            assert quick.receive()[0] == number
        slow.take()
        assert slow.receive()[0] == 11.0


def test_a_stalled_viewer_delays_nobody_and_holds_at_most_two_images(
    console: ConsoleBesideNode, images: JpegPublisher
) -> None:
    with console.client.viewer() as stalled, console.client.viewer() as quick:
        wait_for_subscribers(console, images, 1)
        images.publish(LARGE)
        assert quick.receive()[0] == 1.0
        for number in range(2, 100):
            quick.take()
            images.publish(LARGE)
            assert quick.receive()[0] == number
        assert stalled.receive()[0] == 1.0
        stalled.take()
        assert stalled.receive()[0] == 99.0
        with pytest.raises(TimeoutError):
            stalled.receive(0.1)


def test_a_second_viewer_begins_with_the_newest_image(
    console: ConsoleBesideNode, images: JpegPublisher
) -> None:
    with console.client.viewer() as first:
        wait_for_subscribers(console, images, 1)
        images.publish()
        assert first.receive()[0] == 1.0
        with console.client.viewer() as second:
            assert second.receive()[0] == 1.0


def test_each_camera_and_node_has_its_own_images(console: ConsoleBesideNode) -> None:
    name = "/robot/eyes"
    words = ["--ros-args", "-r", "__node:=eyes", "-r", "__ns:=/robot", "-p", "cameras:=[front, rear]"]
    with ServedNode(Preparations(), arguments=words) as served, console.client.page() as page:
        page.wait_for(lambda: name in page.nodes, "the second detector")
        topics = {camera: f"{name}/{camera}/image/compressed" for camera in ("front", "rear")}
        publishers = {camera: JpegPublisher(served.client, topic) for camera, topic in topics.items()}
        with console.client.viewer(name, "front") as front, console.client.viewer(name, "rear") as rear:
            served.wait_for(
                lambda: all(publisher.subscribers == 1 for publisher in publishers.values()),
                "the subscriptions",
            )
            publishers["rear"].publish(7)
            publishers["front"].publish(5)
            assert front.receive() == (1.0, bytes(5))
            assert rear.receive() == (1.0, bytes(7))


@pytest.mark.parametrize(
    ("node", "camera"),
    [
        pytest.param("/nobody", "", id="node"),
        pytest.param(NODE, "front", id="camera"),
        pytest.param("/robot/../yolov5", "", id="path"),
        pytest.param("", "", id="nothing"),
    ],
)
def test_an_unknown_camera_is_refused(console: ConsoleBesideNode, node: str, camera: str) -> None:
    with console.client.viewer(node, camera) as viewer, pytest.raises(ConnectionClosed) as closed:
        viewer.receive()
    assert closed.value.rcvd is not None
    assert closed.value.rcvd.code == 4404


def test_another_word_than_taken_closes_the_connection(console: ConsoleBesideNode) -> None:
    with console.client.viewer() as viewer:
        viewer.connection.send("more")
        with pytest.raises(ConnectionClosed) as closed:
            viewer.receive()
    assert closed.value.rcvd is not None
    assert closed.value.rcvd.code == 1008


@pytest.mark.long
def test_the_detector_stays_lazy_until_somebody_looks(console: ConsoleBesideNode) -> None:
    name, topic = "/lazy", "/lazy/image_raw"
    words = ["--ros-args", "-r", "__node:=lazy"]
    with ServedNode(Preparations(), arguments=words) as served, console.client.page() as page:
        page.wait_for(lambda: name in page.nodes, "the lazy detector")
        for label in ("configure", "activate"):
            assert page.ask(type="transition", node=name, label=label) == ""
        camera = served.client.create_publisher(Image, topic, 1)
        page.wait_for_state("active", name)
        assert served.client.count_subscribers(topic) == 0
        with console.client.viewer(name) as viewer:
            served.wait_for(lambda: camera.get_subscription_count() == 1, "the detector to receive images")
            camera.publish(image())
            _, jpeg = viewer.receive()
            assert jpeg.startswith(b"\xff\xd8")
        served.wait_for(lambda: served.client.count_subscribers(topic) == 0, "the detector to receive none")
