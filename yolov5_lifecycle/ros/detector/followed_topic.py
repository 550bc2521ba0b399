"""A subscription with the QoS that the publishers of its topic offer."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

from yolov5_lifecycle.printable import in_one_line
from yolov5_lifecycle.ros.qos_overrides import overridden_reliability, overriding_options
from yolov5_lifecycle.ros.topics import endpoint_name, full_name


class FollowedTopic:
    """Owns a subscription (keep last `depth`) to `topic` from the first `follow` to `close`.

    A QoS override of the topic sets its reliability, else `reliability` does, else the publishers: reliable
    if every one of them is. Publishers also set its durability, with which it receives what was latched
    before. `take` and `events` are called in the executor.

    A subscription that cannot be created is logged once with its `consequence`; the next `follow` retries.
    `problem` says why, and is "" while there is none.
    """

    def __init__(
        self,
        node: Node,
        topic: str,
        message_type: type,
        take: Callable[..., None],
        *,
        depth: int,
        reliability: ReliabilityPolicy | None = None,
        consequence: str = "",
        events: SubscriptionEventCallbacks | None = None,
    ) -> None:
        self._node = node
        self._topic = topic
        self._message_type = message_type
        self._take = take
        self._depth = depth
        overridden = overridden_reliability(node, topic)
        # Not `or`: system_default is 0, thus falsy.
        self._wanted = reliability if overridden is None else overridden
        self._consequence = consequence
        self._events = events
        self._subscription: Any = None
        self.reliability = ReliabilityPolicy.BEST_EFFORT
        self._durability = DurabilityPolicy.VOLATILE
        self.problem = ""

    def follow(
        self, reliabilities: Sequence[ReliabilityPolicy], durabilities: Sequence[DurabilityPolicy] = ()
    ) -> bool:
        """Subscribe, or subscribe again if the publishers offer something else; whether it did either."""
        reliability = common_reliability(reliabilities) if self._wanted is None else self._wanted
        durability = common_durability(durabilities)
        if self._subscription is not None and (reliability, durability) == (
            self.reliability,
            self._durability,
        ):
            return False
        self.close()
        self.reliability, self._durability = reliability, durability
        try:
            self._subscription = self._subscribed()
        except Exception as error:  # noqa: BLE001 - rclpy raises several types; reported and retried
            self._tell(error)
            return False
        self.problem = ""
        return True

    def close(self) -> None:
        if self._subscription is not None:
            self._node.destroy_subscription(self._subscription)
            self._subscription = None

    def _subscribed(self) -> Any:
        return self._node.create_subscription(
            self._message_type,
            endpoint_name(self._node, self._topic),
            self._take,
            QoSProfile(
                depth=self._depth,
                history=HistoryPolicy.KEEP_LAST,
                reliability=self.reliability,
                durability=self._durability,
            ),
            event_callbacks=self._events,
            qos_overriding_options=overriding_options(self._node, self._topic, "subscription"),
        )

    def _tell(self, error: Exception) -> None:
        name = in_one_line(full_name(self._node, self._topic))
        problem = f"cannot subscribe to {name}: {in_one_line(str(error))}{self._consequence}"
        if problem != self.problem:
            self._node.get_logger().error(problem)
        self.problem = problem


def common_reliability(offers: Sequence[ReliabilityPolicy]) -> ReliabilityPolicy:
    """Reliable if every publisher is, else best effort, which matches all publishers."""
    reliable = bool(offers) and all(offer is ReliabilityPolicy.RELIABLE for offer in offers)
    return ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT


def common_durability(offers: Sequence[DurabilityPolicy]) -> DurabilityPolicy:
    """Transient local if every publisher is, else volatile, which matches all publishers."""
    latched = bool(offers) and all(offer is DurabilityPolicy.TRANSIENT_LOCAL for offer in offers)
    return DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE
