"""Subscriptions whose QoS follows what the publishers of their topic offer; the one to images."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import KW_ONLY, dataclass
from typing import Any, Literal, TypeVar

from rclpy.event_handler import QoSMessageLostInfo, QoSSubscriptionMatchedInfo, SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CompressedImage, Image

from yolov5_lifecycle.printable import in_one_line
from yolov5_lifecycle.ros.detector.image_topic import RAW, ImageTopic
from yolov5_lifecycle.ros.qos_overrides import overridden_reliability, overriding_options
from yolov5_lifecycle.ros.topics import endpoint_name, full_name

Policy = TypeVar("Policy", ReliabilityPolicy, DurabilityPolicy)
Reliability = Literal["auto", "best_effort", "reliable"]

WINDOW_S = 5.0
"""Window over which recent losses are counted, in seconds."""
_POLICIES = {
    "auto": None,
    "best_effort": ReliabilityPolicy.BEST_EFFORT,
    "reliable": ReliabilityPolicy.RELIABLE,
}


@dataclass(eq=False)
class Subscription:
    """Owns a subscription that keeps the last `depth` messages, from the first `follow` to `close`.

    `topic` is its name before remapping. A `qos_overrides` of the topic decides on the reliability, else
    `reliability`, else the publishers. With `takes_latched` the durability follows the publishers as well, so
    that messages latched earlier are received; without, it is volatile.

    If the subscription cannot be created, this is logged and stays in `problem`, with `consequence` at its
    end; every `follow` retries.
    """

    node: Node
    topic: str
    message_type: type
    take: Callable[..., None]
    _: KW_ONLY
    depth: int
    reliability: ReliabilityPolicy | None = None
    takes_latched: bool = False
    events: SubscriptionEventCallbacks | None = None
    consequence: str = ""

    def __post_init__(self) -> None:
        overridden = overridden_reliability(self.node, self.topic)
        # Not `or`: system_default is 0, thus falsy.
        self._decided = self.reliability if overridden is None else overridden
        self._name = full_name(self.node, self.topic)
        self._type_name = f"{self.message_type.__module__.partition('.')[0]}/msg/{self.message_type.__name__}"
        self._subscription: Any = None
        self._seen_s = time.monotonic()
        self.name = in_one_line(self._name)
        self.subscribed = ReliabilityPolicy.BEST_EFFORT, DurabilityPolicy.VOLATILE
        """Reliability and durability."""
        self.publishers = 0
        """Number of publishers of the right type at the last `follow`."""
        self.missing_s = 0.0
        """Seconds without such a publisher until then."""
        self.problem = ""

    def follow(self) -> bool:
        """Subscribe again if the publishers in the ROS graph require it; return whether this subscribed."""
        infos = self.node.get_publishers_info_by_topic(self._name)
        offers = [info.qos_profile for info in infos if info.topic_type == self._type_name]
        now_s = time.monotonic()
        self._seen_s = now_s if offers else self._seen_s
        self.publishers, self.missing_s = len(offers), now_s - self._seen_s
        wanted = self._wanted(offers)
        if self._subscription is not None and wanted == self.subscribed:
            return False
        self.close()
        self.subscribed = wanted
        return self._subscribe()

    def close(self) -> None:
        """Receive no more messages until the next `follow`."""
        if self._subscription is not None:
            self.node.destroy_subscription(self._subscription)
            self._subscription = None

    def _wanted(self, offers: Sequence[QoSProfile]) -> tuple[ReliabilityPolicy, DurabilityPolicy]:
        reliability, durability = self._decided, DurabilityPolicy.VOLATILE
        if reliability is None:
            reliabilities = [offer.reliability for offer in offers]
            reliability = _common(reliabilities, ReliabilityPolicy.RELIABLE, ReliabilityPolicy.BEST_EFFORT)
        if self.takes_latched:
            durabilities = [offer.durability for offer in offers]
            durability = _common(durabilities, DurabilityPolicy.TRANSIENT_LOCAL, DurabilityPolicy.VOLATILE)
        return reliability, durability

    def _subscribe(self) -> bool:
        try:
            self._subscription = self.node.create_subscription(
                self.message_type,
                endpoint_name(self.node, self.topic),
                self.take,
                QoSProfile(
                    depth=self.depth,
                    history=HistoryPolicy.KEEP_LAST,
                    reliability=self.subscribed[0],
                    durability=self.subscribed[1],
                ),
                event_callbacks=self.events,
                qos_overriding_options=overriding_options(self.node, self.topic, "subscription"),
            )
        except Exception as error:  # noqa: BLE001 - rclpy raises several types; reported and retried
            problem = f"cannot subscribe to {self.name}: {in_one_line(str(error))}{self.consequence}"
            if problem != self.problem:
                self.node.get_logger().error(problem)
            self.problem = problem
            return False
        self.problem = ""
        return True


def _common(offers: Sequence[Policy], strict: Policy, lenient: Policy) -> Policy:
    """`strict` if every publisher offers it, else `lenient`, which matches all publishers."""
    return strict if offers and all(offer is strict for offer in offers) else lenient


@dataclass(frozen=True)
class ReceivedFrame:
    """An image message and the monotonic time at which the executor took it, in seconds."""

    message: Image | CompressedImage
    received_s: float


@dataclass(frozen=True)
class InputStatus:
    """QoS reliability, time since the last image in seconds, and the max size of an image, in bytes.

    `received` and `lost` are the images of the last `window_s` seconds.
    """

    reliability: ReliabilityPolicy
    silent_s: float
    window_s: float
    received: int
    lost: int
    max_bytes: int


class ImageLosses:
    """Counts images that publishers sent and this node never took.

    `lost`: reported by the middleware (the event `message_lost`), which counts per publisher; correct for
    any number of publishers.

    `dropped_in_queue`: sent and not lost, but replaced by a newer image before it was taken, or sent while
    the node resubscribed. Computed as the gaps in the publisher's sequence numbers minus `lost`. rclpy does
    not expose which publisher sent a message, so gaps count only between messages that arrived while the same
    single publisher was matched. Only `settle` updates `dropped_in_queue`.
    """

    def __init__(self) -> None:
        self.lost = 0
        self.dropped_in_queue = 0
        self._before_run = 0
        self._publisher: bytes | None = None
        self._is_counting = False
        self._begun_ns = 0
        self._last_number: int | None = None
        self._gaps = 0
        self._lost_before = 0

    def subscribe(self) -> None:
        """Handle a (re)subscription; images that the same publisher sent in between count as missed."""
        if self._publisher is None:
            self._restart(None, 0)
            self._is_counting = True

    def take(self, number: int | None, received_ns: int) -> None:
        """Record a taken message: sequence number, None if the middleware has none, and arrival time."""
        if number is None or not self._is_counting or received_ns < self._begun_ns:
            return
        if self._last_number is None:
            self._lost_before = self.lost
        elif number > self._last_number:
            self._gaps += number - self._last_number - 1
        self._last_number = number

    def lose(self, count: int) -> None:
        """Add `count` messages that the middleware lost, from any publisher."""
        self.lost += count

    def match(self, publisher: bytes | None, *, ever_matched: int, has_joined: bool, now_ns: int) -> None:
        """Handle a change of the matched publishers.

        `publisher`: gid of the only publisher, None unless there is exactly one. `ever_matched`: total number
        of publishers matched so far. `has_joined`: whether a publisher was added since the last call.
        """
        if ever_matched == 1 and publisher is not None and self._publisher in (None, publisher):
            self._publisher = publisher
            return
        if not has_joined:
            self.settle()
        # Else a message of the new publisher may already have been taken: drop the unsettled gaps.
        self._restart(publisher, now_ns)

    def stop(self) -> None:
        """Handle an unsubscription; images sent from now on do not count."""
        self.settle()
        self._restart(None, 0)

    def settle(self) -> None:
        """Add the gaps seen so far to `dropped_in_queue`.

        The middleware may report a loss after its gap was added: then `dropped_in_queue` falls by as many as
        `lost` has grown, so that no image is counted twice.
        """
        run = max(0, self._gaps - (self.lost - self._lost_before)) if self._gaps else 0
        self.dropped_in_queue = self._before_run + run

    def _restart(self, publisher: bytes | None, now_ns: int) -> None:
        self._before_run = self.dropped_in_queue
        self._publisher = publisher
        self._is_counting = publisher is not None
        self._begun_ns = now_ns
        self._last_number = None
        self._gaps = 0
        self._lost_before = self.lost


@dataclass(eq=False)
class ImageInput:
    """Owns the image subscription: keep last 1, reliability as requested or as the publishers offer.

    `qos_overrides` of the topic take precedence over both. `losses` counts images sent but never taken. See
    `Subscription` for what happens if it cannot be created.
    """

    node: Node
    _: KW_ONLY
    topic: ImageTopic
    reliability: Reliability
    on_frame: Callable[[ReceivedFrame], None]
    losses: ImageLosses

    def __post_init__(self) -> None:
        self._last_frame_s = time.monotonic()
        self._received = self._max_bytes = 0
        # (time in s, images received, images lost), one per call of `update` within the window
        self._samples: deque[tuple[float, int, int]] = deque([(self._last_frame_s, 0, self.losses.lost)])
        self._subscription = Subscription(
            self.node,
            self.topic.local_name,
            Image if self.topic.transport == RAW else CompressedImage,
            self._take,
            depth=1,
            reliability=_POLICIES[self.reliability],
            events=SubscriptionEventCallbacks(message_lost=self._lose, matched=self._match),
            consequence=". Nothing is detected meanwhile; retrying every second",
        )
        self._follow()

    @property
    def problem(self) -> str:
        """Why there is no subscription, "" if there is one."""
        return self._subscription.problem

    def update(self) -> None:
        """Subscribe again if what the publishers offer requires it; count recent losses."""
        self.losses.settle()
        self._follow()
        now_s = time.monotonic()
        self._samples.append((now_s, self._received, self.losses.lost))
        while len(self._samples) > 2 and now_s - self._samples[1][0] >= WINDOW_S:
            self._samples.popleft()

    def status(self) -> InputStatus:
        begun_s, received, lost = self._samples[0]
        ended_s, last_received, last_lost = self._samples[-1]
        return InputStatus(
            reliability=self._subscription.subscribed[0],
            silent_s=time.monotonic() - self._last_frame_s,
            window_s=ended_s - begun_s,
            received=last_received - received,
            lost=last_lost - lost,
            max_bytes=self._max_bytes,
        )

    def close(self) -> None:
        self._subscription.close()
        self.losses.settle()

    def _follow(self) -> None:
        if self._subscription.follow():
            self.losses.subscribe()

    def _match(self, event: QoSSubscriptionMatchedInfo) -> None:
        self.losses.match(
            self.topic.publisher() if event.current_count == 1 else None,
            ever_matched=event.total_count,
            has_joined=event.total_count_change > 0,
            now_ns=time.time_ns(),  # compared with the system time at which the middleware received messages
        )

    def _lose(self, event: QoSMessageLostInfo) -> None:
        self.losses.lose(event.total_count_change)

    def _take(self, message: Image | CompressedImage, info: dict[str, int]) -> None:
        self.losses.take(info["publication_sequence_number"], info["received_timestamp"])
        self._last_frame_s = time.monotonic()
        self._received += 1
        self._max_bytes = max(self._max_bytes, len(message.data))
        self.on_frame(ReceivedFrame(message, self._last_frame_s))
