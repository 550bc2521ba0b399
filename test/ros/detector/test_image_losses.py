"""Images that were sent but never received are counted per publisher, and never across publishers."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing

import pytest
import rclpy
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import Image
from support.detector_process import as_arguments, environment
from support.lone_node import lone_node

from yolov5_lifecycle.ros.child_process import ChildProcess, entry_point
from yolov5_lifecycle.ros.detector.camera_topic import colour_topic
from yolov5_lifecycle.ros.detector.image_input import ImageInput, ImageLosses, ReceivedFrame, Subscription
from yolov5_lifecycle.ros.observer import Observer

FRONT, REAR = b"front", b"rear"
TOPIC = "/receiver/image_raw"


Step = tuple[object, ...]
"""What happens: images with these sequence numbers are taken, also one that came `late`, or another event."""


def losses_after(*steps: Step) -> ImageLosses:
    """Those of a subscription that has matched one publisher, after these steps at times 1, 2, 3 ..."""
    losses = ImageLosses()
    losses.match(FRONT, ever_matched=1, has_joined=True, now_ns=0)
    for now_ns, (what, *values) in enumerate(steps, start=1):
        if what == "take":
            for number in values:
                losses.take(number, now_ns)  # type: ignore[arg-type]
        elif what == "late":
            losses.take(values[0], now_ns - 2)  # type: ignore[arg-type]
        elif what == "lose":
            losses.lost += values[0]  # type: ignore[operator]
        elif what == "match":
            publisher, ever_matched, has_joined = values
            losses.match(publisher, ever_matched=ever_matched, has_joined=has_joined, now_ns=now_ns)  # type: ignore[arg-type]
        else:
            getattr(losses, str(what))(*values)
    losses.settle()
    return losses


@pytest.mark.parametrize(
    ("steps", "lost", "dropped_in_queue"),
    [
        pytest.param([("take", 7, 8, 12), ("lose", 1)], 1, 2, id="a gap that was not all lost"),
        pytest.param([("lose", 5), ("take", 6, 9)], 5, 2, id="lost before the first image"),
        pytest.param(
            [("take", 1, 4), ("settle",), ("lose", 1)], 1, 1, id="a loss that is reported after its gap"
        ),
        pytest.param(
            [
                ("take", 1, 4),
                ("settle",),
                ("take", 5000, 5, 5001),  # taken before the event of the match
                ("match", None, 2, True),
                ("take", 6, 5010),
            ],
            0,
            2,
            id="a second publisher ends the count and takes back what it caused",
        ),
        pytest.param(
            # The late one is the last of the other, still in the queue.
            [("match", None, 2, True), ("match", FRONT, 2, False), ("late", 90), ("take", 100, 103)],
            0,
            2,
            id="counting begins again when the second has left",
        ),
        pytest.param(
            [("take", 1, 700), ("match", FRONT, 2, True), ("take", 2, 4)],
            0,
            1,
            id="another came and went unseen between two images",
        ),
        pytest.param(
            [("take", 1, 4), ("match", None, 1, False)], 0, 2, id="the end of the only one keeps its gaps"
        ),
        pytest.param(
            [
                ("take", 1),
                ("take", 4),
                ("match", FRONT, 1, True),
                ("take", 900),
                ("match", REAR, 1, True),
                ("take", 901, 903),
            ],
            0,
            1,  # the gap before the other publisher was not settled yet
            id="the same publisher is counted on over a new subscription, another is not",
        ),
        pytest.param(
            [("match", None, 2, True), ("match", FRONT, 1, True), ("take", 10, 14)],
            0,
            3,
            id="a new subscription after two publishers",
        ),
        pytest.param(
            [("take", 1, 3), ("stop",), ("match", FRONT, 1, True), ("take", 50, 52)],
            0,
            2,
            id="sent while the node wants no images",
        ),
        pytest.param(
            [("stop",), ("take", 50), ("match", FRONT, 1, True), ("late", 52)],
            0,
            1,
            id="received before the event of the match, taken after it",
        ),
        pytest.param([("take", 1), ("lose", 5)], 5, 0, id="lost without a gap"),
        pytest.param([("take", 5, 5, 8)], 0, 2, id="taken twice"),
        pytest.param([("take", None, None)], 0, 0, id="a middleware without sequence numbers"),
    ],
)
def test_images_between_two_that_the_same_publisher_sent_are_lost_or_dropped(
    steps: list[Step], lost: int, dropped_in_queue: int
) -> None:
    losses = losses_after(*steps)
    assert (losses.lost, losses.dropped_in_queue) == (lost, dropped_in_queue)


class Receiver:
    """An image subscription over the real middleware, whose node works only when it is told to."""

    def __init__(self, domain: int) -> None:
        self.node = Observer("receiver", domain=domain)
        # In the same participant: Fast DDS may hang when several of one process end (eProsima/Fast-DDS#6193).
        self.sender = rclpy.create_node("sender", context=self.node.context)
        self.received: list[ReceivedFrame] = []
        self.topic = colour_topic(self.node, "raw")
        self.input = ImageInput(self.received.append)
        self.losses = self.input.losses
        self.input.follow(self.topic, "auto")

    def close(self) -> None:
        self.input.follow(None, "auto")
        self.sender.destroy_node()
        self.node.close()

    def publisher(self, durability: DurabilityPolicy = DurabilityPolicy.VOLATILE) -> Publisher:
        """A reliable one that the node has found."""
        matched = self.topic.look().publishers
        publisher = self.sender.create_publisher(Image, TOPIC, QoSProfile(depth=1, durability=durability))
        self.node.wait_for(lambda: self.topic.look().publishers == matched + 1, "the publisher")
        self.input.update()

        def is_matched() -> bool:
            """It first subscribes as best effort, and images between its two subscriptions are lost."""
            infos = self.sender.get_subscriptions_info_by_topic(TOPIC)
            reliabilities = [info.qos_profile.reliability.name for info in infos]
            return reliabilities == ["RELIABLE"] and publisher.get_subscription_count() == 1

        self.node.wait_for(is_matched, "the reliable subscription")
        return publisher

    def send(self, publisher: Publisher, count: int = 1) -> None:
        """Publish so many at once; only the last can be taken, since one is kept."""
        before = len(self.received)
        for _ in range(count):
            publisher.publish(Image())
        self.node.wait_for(lambda: len(self.received) > before, "an image")


@pytest.fixture
def receiver(ros_domain: int) -> Iterator[Receiver]:
    with closing(Receiver(ros_domain)) as receiver:
        yield receiver


@pytest.mark.long
def test_images_that_the_middleware_loses_are_counted_as_lost(
    ros_domain: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Best effort, and larger than what the network keeps for a receiver.

    Without shared memory, because Fast DDS 2.14 crashes now and then when it removes a participant whose port
    such a camera has flooded, as it locks a mutex in memory that is not mapped any more; compare
    eProsima/Fast-DDS#4737.
    """
    monkeypatch.delenv("FASTRTPS_DEFAULT_PROFILES_FILE", raising=False)
    monkeypatch.setenv("FASTDDS_BUILTIN_TRANSPORTS", "UDPv4")
    size = {"reliability": "best_effort", "width": 1280, "height": 960}
    words = [entry_point("camera"), "--ros-args", "-r", f"image_raw:={TOPIC}", *as_arguments(size)]
    with (
        closing(Receiver(ros_domain)) as receiver,
        ChildProcess("camera", words, environment(ros_domain)),
    ):
        receiver.node.wait_for(lambda: receiver.losses.lost >= 5, "losses")


def test_a_second_camera_that_joins_and_leaves_adds_nothing(receiver: Receiver) -> None:
    first = receiver.publisher()
    receiver.send(first)
    second = receiver.publisher()
    for _ in range(3):
        receiver.send(second, 50)
        receiver.send(first)
        receiver.input.update()
    receiver.sender.destroy_publisher(second)
    for _ in range(100):  # until the node has seen that one is left
        receiver.send(first, 3)
        receiver.input.update()
        if receiver.losses.dropped_in_queue:
            break
    assert (receiver.losses.lost, receiver.losses.dropped_in_queue) == (0, 2)


def test_images_sent_while_the_node_subscribes_again_are_counted_and_no_old_one_is_taken(
    receiver: Receiver,
) -> None:
    camera = receiver.publisher(DurabilityPolicy.TRANSIENT_LOCAL)
    receiver.send(camera)
    for _ in range(4):
        camera.publish(Image())
    receiver.input.follow(receiver.topic, "reliable")  # as a change of `image_reliability` does
    receiver.node.wait_for(lambda: camera.get_subscription_count() == 1, "the new subscription")
    receiver.send(camera)
    receiver.input.update()
    assert (len(receiver.received), receiver.losses.lost, receiver.losses.dropped_in_queue) == (2, 0, 4)
    (subscription,) = receiver.node.get_subscriptions_info_by_topic(TOPIC)
    assert subscription.qos_profile.durability is DurabilityPolicy.VOLATILE


def test_an_override_of_the_depth_does_not_make_the_node_subscribe_again(ros_domain: int) -> None:
    words = ("--ros-args", "-p", f"qos_overrides.{TOPIC}.subscription.depth:=5")
    with lone_node("receiver", *words) as node:
        subscription = Subscription(colour_topic(node, "raw"), lambda _: None, depth=1)
        subscription.follow()
        (first,) = node.subscriptions
        subscription.follow()
        assert [*node.subscriptions] == [first]
        subscription.close()
