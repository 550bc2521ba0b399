"""Subscriptions whose QoS follows what the publishers of their topic offer; the one to images."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import KW_ONLY, dataclass
from functools import partial
from typing import Any, Literal, TypeVar

from rclpy.event_handler import QoSMessageLostInfo, QoSSubscriptionMatchedInfo, SubscriptionEventCallbacks
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CompressedImage, Image

from yolov5_lifecycle.ros.detector.camera_topic import CameraTopic
from yolov5_lifecycle.ros.topics import endpoint_name, overridden_reliability, overriding_options

Policy = TypeVar("Policy", ReliabilityPolicy, DurabilityPolicy)
Reliability = Literal["auto", "best_effort", "reliable"]

WINDOW_S = 5.0
"""Window over which recent losses are counted, in seconds."""


@dataclass(eq=False)
class Subscription:
    """Owns a subscription to `topic` from the first `follow` to `close`; it keeps the last `depth` messages.

    A `qos_overrides` of the topic decides on the reliability, else `reliability`, else the publishers. With
    `takes_latched` the durability follows the publishers as well, so that messages latched earlier are
    received; without, it is volatile.

    Raises rclpy's exception if the subscription cannot be created; every `follow` retries.
    """

    topic: CameraTopic
    take: Callable[..., None]
    _: KW_ONLY
    depth: int
    reliability: ReliabilityPolicy | None = None
    takes_latched: bool = False
    events: SubscriptionEventCallbacks | None = None

    def __post_init__(self) -> None:
        overridden = overridden_reliability(self.topic.node, self.topic.local_name)
        # Not `or`: system_default is 0, thus falsy.
        self._decided = self.reliability if overridden is None else overridden
        self._subscription: Any = None
        self.qos = self._wanted(())

    def follow(self) -> None:
        """Subscribe again if the publishers in the ROS graph require it."""
        wanted = self._wanted(self.topic.look().offers)
        if self._subscription is not None and wanted == self.qos:
            return
        self.close()
        self.qos = wanted
        topic, node = self.topic, self.topic.node
        self._subscription = node.create_subscription(
            topic.message_type,
            endpoint_name(node, topic.local_name),
            self.take,
            copy(wanted),  # which rclpy changes where there are overrides
            event_callbacks=self.events,
            qos_overriding_options=overriding_options(node, topic.local_name, "subscription"),
        )

    def close(self) -> None:
        """Receive no more messages until the next `follow`."""
        if self._subscription is not None:
            self.topic.node.destroy_subscription(self._subscription)
            self._subscription = None

    def _wanted(self, offers: Sequence[QoSProfile]) -> QoSProfile:
        reliability, durability = self._decided, DurabilityPolicy.VOLATILE
        if reliability is None:
            reliabilities = [offer.reliability for offer in offers]
            reliability = _common(reliabilities, ReliabilityPolicy.RELIABLE, ReliabilityPolicy.BEST_EFFORT)
        if self.takes_latched:
            durabilities = [offer.durability for offer in offers]
            durability = _common(durabilities, DurabilityPolicy.TRANSIENT_LOCAL, DurabilityPolicy.VOLATILE)
        return QoSProfile(depth=self.depth, reliability=reliability, durability=durability)


def _common(offers: Sequence[Policy], strict: Policy, lenient: Policy) -> Policy:
    """`strict` if every publisher offers it, else `lenient`, which matches all publishers."""
    return strict if offers and all(offer is strict for offer in offers) else lenient


@dataclass(frozen=True)
class ReceivedFrame:
    """An image message and the monotonic time at which the executor took it, in seconds."""

    message: Image | CompressedImage
    received_s: float


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
        self._before_run = self._gaps = self._lost_before = 0
        self._publisher: bytes | None = None
        self._begun_ns = 0.0
        self._last_number: int | None = None

    def take(self, number: int | None, received_ns: int) -> None:
        """Record a taken message: sequence number, None if the middleware has none, and arrival time."""
        if number is None or received_ns < self._begun_ns:
            return
        if self._last_number is None:
            self._lost_before = self.lost
        elif number > self._last_number:
            self._gaps += number - self._last_number - 1
        self._last_number = number

    def match(self, publisher: bytes | None, *, ever_matched: int, has_joined: bool, now_ns: int) -> None:
        """Handle a change of the matched publishers.

        `publisher`: gid of the only publisher, None unless there is exactly one. `ever_matched`: total number
        of publishers matched so far. `has_joined`: whether a publisher was added since the last call.
        """
        if ever_matched == 1 and publisher is not None and self._publisher in (None, publisher):
            self._publisher, self._begun_ns = publisher, min(self._begun_ns, now_ns)
            return
        if not has_joined:
            self.settle()
        # Else a message of the new publisher may already have been taken: drop the unsettled gaps.
        self._restart(publisher, math.inf if publisher is None else now_ns)

    def stop(self) -> None:
        """Handle an unsubscription; images sent from now on do not count."""
        self.settle()
        self._restart(None, 0)

    def settle(self) -> None:
        """Add the gaps seen so far to `dropped_in_queue`.

        The middleware may report a loss after its gap was added: then `dropped_in_queue` falls by as many as
        `lost` has grown, so that no image is counted twice.
        """
        run = max(0, self._gaps - (self.lost - self._lost_before))
        self.dropped_in_queue = self._before_run + run

    def _restart(self, publisher: bytes | None, begin_ns: float) -> None:
        """Count the gaps between the images received from `begin_ns` on."""
        self._before_run = self.dropped_in_queue
        self._publisher = publisher
        self._begun_ns = begin_ns
        self._last_number = None
        self._gaps = 0


class ImageInput:
    """Receives the images of a camera while they are needed: keep last 1, reliability as requested or as the
    publishers offer.

    `qos_overrides` of the topic take precedence over both. `losses` counts images sent but never taken.
    """

    def __init__(self, on_frame: Callable[[ReceivedFrame], None]) -> None:
        self.losses = ImageLosses()
        self._on_frame = on_frame
        self._subscription: Subscription | None = None
        self._reliability: Reliability = "auto"
        self._last_frame_s = 0.0
        self._received = self.max_bytes = 0
        """Images, and the max size of one in bytes, since the subscription to the topic."""
        self._samples: deque[tuple[float, int, int]] = deque()
        """Time in s, images received, images lost: one per call of `update` within the window."""

    def follow(self, topic: CameraTopic | None, reliability: Reliability) -> None:
        """Receive the images of `topic` from now on; with None no more."""
        before = self._subscription
        if before is not None:
            if topic is before.topic and reliability == self._reliability:
                return
            before.close()
            if topic is not before.topic:
                self.losses.stop()
        self._subscription, self._reliability = None, reliability
        if topic is not None:
            self._subscribe(topic)

    def update(self) -> None:
        """Subscribe again if what the publishers offer requires it; count recent losses."""
        if self._subscription is None:
            return
        self.losses.settle()
        now_s = time.monotonic()
        self._samples.append((now_s, self._received, self.losses.lost))
        while len(self._samples) > 2 and now_s - self._samples[1][0] >= WINDOW_S:
            self._samples.popleft()
        self._subscription.follow()  # last, because it may raise

    @property
    def reliability(self) -> ReliabilityPolicy | None:
        """That of the subscription, None without one."""
        return self._subscription.qos.reliability if self._subscription else None

    @property
    def silent_s(self) -> float:
        """Seconds since the last image, or since the subscription."""
        return time.monotonic() - self._last_frame_s

    def recent(self) -> tuple[int, int, float]:
        """Images received and lost in the last seconds, and how many seconds these are."""
        begun_s, received, lost = self._samples[0]
        ended_s, last_received, last_lost = self._samples[-1]
        return last_received - received, last_lost - lost, ended_s - begun_s

    def _subscribe(self, topic: CameraTopic) -> None:
        self._last_frame_s = time.monotonic()
        self._received = self.max_bytes = 0
        self._samples.clear()
        self._subscription = Subscription(
            topic,
            self._take,
            depth=1,
            reliability=None if self._reliability == "auto" else ReliabilityPolicy[self._reliability.upper()],
            events=SubscriptionEventCallbacks(message_lost=self._lose, matched=partial(self._match, topic)),
        )
        self.update()

    def _match(self, topic: CameraTopic, event: QoSSubscriptionMatchedInfo) -> None:
        self.losses.match(
            topic.only_publisher() if event.current_count == 1 else None,
            ever_matched=event.total_count,
            has_joined=event.total_count_change > 0,
            now_ns=time.time_ns(),  # compared with the system time at which the middleware received messages
        )

    def _lose(self, event: QoSMessageLostInfo) -> None:
        self.losses.lost += event.total_count_change

    def _take(self, message: Image | CompressedImage, info: dict[str, int]) -> None:
        self.losses.take(info["publication_sequence_number"], info["received_timestamp"])
        self._last_frame_s = time.monotonic()
        self._received += 1
        self.max_bytes = max(self.max_bytes, len(message.data))
        self._on_frame(ReceivedFrame(message, self._last_frame_s))
