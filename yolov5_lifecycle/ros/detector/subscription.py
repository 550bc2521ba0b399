"""A subscription whose QoS follows what the publishers of its topic offer."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import KW_ONLY, dataclass
from typing import Any, TypeVar

from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

from yolov5_lifecycle.printable import in_one_line
from yolov5_lifecycle.ros.qos_overrides import overridden_reliability, overriding_options
from yolov5_lifecycle.ros.topics import endpoint_name, full_name

Policy = TypeVar("Policy", ReliabilityPolicy, DurabilityPolicy)


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
