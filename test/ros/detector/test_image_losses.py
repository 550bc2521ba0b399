"""Images that were sent but never received are counted per publisher, and never across publishers."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing

import pytest
import rclpy
from hypothesis import given
from hypothesis import strategies as st
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import Image
from support.detector_process import as_arguments, environment, is_matched_reliably
from vision_msgs.msg import Detection2DArray

from yolov5_lifecycle.ros.camera.outputs import CameraOutputs
from yolov5_lifecycle.ros.camera.settings import declared_settings
from yolov5_lifecycle.ros.child_process import ChildProcess, entry_point
from yolov5_lifecycle.ros.detector.image_input import ImageInput, ImageLosses, ReceivedFrame
from yolov5_lifecycle.ros.detector.image_topic import ImageTopic
from yolov5_lifecycle.ros.observer import Observer
from yolov5_lifecycle.sources.source import open_source

FRONT, REAR = b"front", b"rear"
TOPIC = "/receiver/image_raw"


def single(publisher: bytes | None = FRONT) -> ImageLosses:
    """Losses of a subscription that has matched one publisher."""
    losses = ImageLosses()
    losses.subscribe()
    losses.match(publisher, ever_matched=1, has_joined=True, now_ns=0)
    return losses


def take(losses: ImageLosses, *numbers: int, at_ns: int = 1) -> None:
    for number in numbers:
        losses.take(number, at_ns)


def test_gaps_that_nobody_lost_were_dropped_in_queue() -> None:
    losses = single()
    take(losses, 7, 8, 12)
    losses.lose(1)
    losses.settle()
    assert (losses.lost, losses.dropped_in_queue) == (1, 2)


def test_what_was_lost_before_the_first_image_is_no_gap() -> None:
    losses = single()
    losses.lose(5)
    take(losses, 6, 9)
    losses.settle()
    assert (losses.lost, losses.dropped_in_queue) == (5, 2)


def test_a_second_publisher_ends_the_count_and_takes_back_what_it_caused() -> None:
    losses = single()
    take(losses, 1, 4)
    losses.settle()
    take(losses, 5000, 5, 5001)  # taken before the event of the match
    losses.match(None, ever_matched=2, has_joined=True, now_ns=10)
    take(losses, 6, 5010, at_ns=11)
    losses.settle()
    assert losses.dropped_in_queue == 2


def test_counting_begins_again_with_what_arrives_after_the_second_has_left() -> None:
    losses = single()
    losses.match(None, ever_matched=2, has_joined=True, now_ns=10)
    losses.match(FRONT, ever_matched=2, has_joined=False, now_ns=20)
    take(losses, 9000, at_ns=19)  # the last one of the other, still in the queue
    take(losses, 100, 103, at_ns=21)
    losses.settle()
    assert losses.dropped_in_queue == 2


def test_a_publisher_that_came_and_went_unseen_between_two_images_causes_nothing() -> None:
    losses = single()
    take(losses, 1, 700)
    losses.match(FRONT, ever_matched=2, has_joined=True, now_ns=10)
    take(losses, 2, 4, at_ns=11)
    losses.settle()
    assert losses.dropped_in_queue == 1


def test_a_loss_that_is_reported_after_its_gap_was_settled_is_counted_once() -> None:
    losses = single()
    take(losses, 1, 4)
    losses.settle()
    losses.lose(1)
    losses.settle()
    assert (losses.lost, losses.dropped_in_queue) == (1, 1)


def test_the_end_of_the_only_publisher_keeps_its_gaps() -> None:
    losses = single()
    take(losses, 1, 4)
    losses.match(None, ever_matched=1, has_joined=False, now_ns=10)
    losses.settle()
    assert losses.dropped_in_queue == 2


def test_the_same_publisher_is_counted_on_over_a_new_subscription_and_another_is_not() -> None:
    losses = single()
    take(losses, 1)
    losses.subscribe()
    take(losses, 4)
    losses.match(FRONT, ever_matched=1, has_joined=True, now_ns=10)
    losses.subscribe()
    take(losses, 900)
    losses.match(REAR, ever_matched=1, has_joined=True, now_ns=20)
    take(losses, 901, 903, at_ns=21)
    losses.settle()
    assert losses.dropped_in_queue == 1  # the gap before the other publisher was not settled yet


def test_what_is_sent_while_the_node_wants_no_images_is_not_missed() -> None:
    losses = single()
    take(losses, 1, 3)
    losses.stop()
    losses.subscribe()
    losses.match(FRONT, ever_matched=1, has_joined=True, now_ns=10)
    take(losses, 50, 52)
    losses.settle()
    assert losses.dropped_in_queue == 2


def test_a_middleware_without_sequence_numbers_has_no_gaps() -> None:
    losses = single()
    losses.take(None, 1)
    losses.take(None, 2)
    losses.settle()
    assert losses.dropped_in_queue == 0


@given(
    st.lists(
        st.one_of(
            st.tuples(st.just("take"), st.sampled_from("ab"), st.integers(0, 3)),
            st.tuples(st.just("look"), st.just(""), st.just(0)),
        ),
        max_size=30,
    )
)
def test_with_two_publishers_no_more_are_dropped_in_queue_than_the_first_sent_alone(
    steps: list[tuple[str, str, int]],
) -> None:
    """Whatever the order of arrival, when the event of the second match comes before the next look."""
    losses, numbers, is_alone = single(), {"a": 0, "b": 10_000}, True
    missed = 0
    for what, who, gap in steps:
        if what == "look":
            losses.settle()
        elif who == "a" or not is_alone:
            numbers[who] += 1 + gap
            missed += gap if who == "a" and is_alone else 0
            losses.take(numbers[who], 1)
        else:
            is_alone = False
            losses.take(numbers[who], 1)
            losses.match(None, ever_matched=2, has_joined=True, now_ns=2)
    losses.settle()
    assert losses.dropped_in_queue <= missed


class Receiver:
    """An image subscription over the real middleware, whose node works only when it is told to."""

    def __init__(self, domain: int) -> None:
        self.node = Observer("receiver", domain=domain)
        # In the same participant: Fast DDS may hang when several of one process end (eProsima/Fast-DDS#6193).
        self.sender = rclpy.create_node("sender", context=self.node.context)
        self.losses = ImageLosses()
        self.received: list[ReceivedFrame] = []
        self.topic = ImageTopic(self.node, "raw")
        self.input = self._subscribed()

    def close(self) -> None:
        self.input.close()
        self.sender.destroy_node()
        self.node.close()

    def publisher(self, durability: DurabilityPolicy = DurabilityPolicy.VOLATILE) -> Publisher:
        """A reliable one that the node has found."""
        matched = self.topic.look().publishers
        publisher = self.sender.create_publisher(Image, TOPIC, QoSProfile(depth=1, durability=durability))
        self.node.wait_for(lambda: self.topic.look().publishers == matched + 1, "the publisher")
        self.look()
        self.node.wait_for(lambda: is_matched_reliably(self.sender, publisher), "the reliable subscription")
        return publisher

    def subscribe_again(self, publisher: Publisher, missed: int) -> None:
        """As a change of `image_reliability` does, while `missed` images are sent."""
        self.input.close()
        self.node.wait_for(lambda: publisher.get_subscription_count() == 0, "the end of the subscription")
        for _ in range(missed):
            publisher.publish(Image())
        self.input = self._subscribed()
        self.node.wait_for(lambda: publisher.get_subscription_count() == 1, "the new subscription")

    def look(self) -> None:
        self.input.update()

    def send(self, publisher: Publisher, count: int = 1) -> None:
        """Publish so many at once; only the last can be taken, since one is kept."""
        before = len(self.received)
        for _ in range(count):
            publisher.publish(Image())
        self.node.wait_for(lambda: len(self.received) > before, "an image")

    def _subscribed(self) -> ImageInput:
        return ImageInput(
            self.node,
            topic=self.topic,
            reliability="auto",
            on_frame=self.received.append,
            losses=self.losses,
        )


@pytest.fixture
def receiver(ros_domain: int) -> Iterator[Receiver]:
    with closing(Receiver(ros_domain)) as receiver:
        yield receiver


def test_images_that_replace_each_other_while_the_node_is_busy_are_dropped_in_queue_not_lost(
    receiver: Receiver,
) -> None:
    camera = receiver.publisher()
    for count in (1, 3, 1, 5):
        receiver.send(camera, count)
    receiver.look()
    assert len(receiver.received) + receiver.losses.dropped_in_queue == 10
    assert receiver.losses.lost == 0


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
        receiver.look()
    receiver.sender.destroy_publisher(second)
    for _ in range(100):  # until the node has seen that one is left
        receiver.send(first, 3)
        receiver.look()
        if receiver.losses.dropped_in_queue:
            break
    assert (receiver.losses.lost, receiver.losses.dropped_in_queue) == (0, 2)


@pytest.mark.parametrize("durability", [DurabilityPolicy.VOLATILE, DurabilityPolicy.TRANSIENT_LOCAL])
def test_images_sent_while_the_node_subscribes_again_are_counted_and_no_old_one_is_taken(
    receiver: Receiver, durability: DurabilityPolicy
) -> None:
    camera = receiver.publisher(durability)
    receiver.send(camera)
    receiver.subscribe_again(camera, missed=4)
    receiver.send(camera)
    receiver.look()
    assert (len(receiver.received), receiver.losses.lost, receiver.losses.dropped_in_queue) == (2, 0, 4)
    (subscription,) = receiver.node.get_subscriptions_info_by_topic(TOPIC)
    assert subscription.qos_profile.durability is DurabilityPolicy.VOLATILE


def test_the_camera_publishes_the_ground_truth_of_images_that_it_does_not_send(ros_domain: int) -> None:
    """So the ground truths published are not the images sent, unless there is a subscriber to both."""
    with closing(Observer("camera", domain=ros_domain)) as node:
        outputs = CameraOutputs(node, declared_settings(node))
        truths: list[Detection2DArray] = []
        images: list[Image] = []
        node.create_subscription(Detection2DArray, "/camera/truth", truths.append, 10)
        source = open_source("synthetic", size_hw=(64, 64), seed=1, loop=True)
        frame = next(iter(source.frames))
        node.wait_for(lambda: node.count_subscribers("/camera/truth") == 1, "the subscription")
        outputs.publish(frame)
        node.wait_for(lambda: bool(truths), "the truth")
        node.create_subscription(Image, "/image_raw", images.append, 1)
        node.wait_for(lambda: outputs.is_heard, "the subscription to the images")
        outputs.publish(frame)
        node.wait_for(lambda: bool(images) and len(truths) == 2, "the image and its truth")
        assert [image.header for image in images] == [truths[-1].header]
