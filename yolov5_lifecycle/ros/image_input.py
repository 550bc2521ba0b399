"""The subscription to the camera."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

from rclpy.node import Node
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CompressedImage, Image

from yolov5_lifecycle.ros.qos_overrides import overridden_reliability, overriding_options
from yolov5_lifecycle.ros.topics import COMPRESSED_IMAGE_RAW, IMAGE_RAW, endpoint_name, full_name

Transport = Literal["raw", "compressed"]
Reliability = Literal["auto", "best_effort", "reliable"]

_TOPICS: dict[Transport, tuple[str, type]] = {
    "raw": (IMAGE_RAW, Image),
    "compressed": (COMPRESSED_IMAGE_RAW, CompressedImage),
}
_POLICIES = {
    "auto": None,
    "best_effort": ReliabilityPolicy.BEST_EFFORT,
    "reliable": ReliabilityPolicy.RELIABLE,
}


@dataclass(frozen=True)
class ReceivedFrame:
    """An image message and the monotonic time, in seconds, at which the executor took it."""

    message: Image | CompressedImage
    received_s: float


@dataclass(frozen=True)
class InputStatus:
    """The subscription as seen now: who publishes, and how long no frame has come.

    `lately` is since the last look; `lost` counts since activation.
    """

    topic: str
    reliability: ReliabilityPolicy
    publishers: int
    best_effort_publishers: int
    silent_s: float
    received_lately: int
    lost_lately: int
    lost: int


class ImageInput:
    """Owns the image subscription: keep last 1, reliability as asked or as the publishers offer.

    The user's `qos_overrides` of the topic take the place of both.

    `lost` goes on counting gaps in the publisher's sequence numbers: frames lost on the wire or overwritten
    before they were taken. It is only counted while the topic has a single publisher, since numbers of
    several cannot be told apart.
    """

    def __init__(
        self,
        node: Node,
        *,
        transport: Transport,
        reliability: Reliability,
        on_frame: Callable[[ReceivedFrame], None],
        lost: int = 0,
    ) -> None:
        self._node = node
        self._on_frame = on_frame
        self._topic, self._message_type = _TOPICS[transport]
        overridden = overridden_reliability(node, self._topic)
        # Not `or`: system_default is 0.
        self._wanted = _POLICIES[reliability] if overridden is None else overridden
        self._single_publisher = True
        self._sequence_number: int | None = None
        self._last_frame_s = time.monotonic()
        self.lost = lost
        self._received = 0
        self._seen = (0, lost)  # received and lost at the last look
        offers = self._offers()
        self._reliability = self._policy(offers)
        self._subscription = self._subscribe()

    def look(self) -> InputStatus:
        """Look at the publishers again; with `auto`, subscribe anew when they offer another reliability."""
        offers = self._offers()
        received, lost = self._received - self._seen[0], self.lost - self._seen[1]
        self._seen = (self._received, self.lost)
        if self._policy(offers) is not self._reliability:
            self._reliability = self._policy(offers)
            self._node.destroy_subscription(self._subscription)
            self._subscription = self._subscribe()
        return InputStatus(
            topic=full_name(self._node, self._topic),
            received_lately=received,
            lost_lately=lost,
            reliability=self._reliability,
            publishers=len(offers),
            best_effort_publishers=offers.count(ReliabilityPolicy.BEST_EFFORT),
            silent_s=time.monotonic() - self._last_frame_s,
            lost=self.lost,
        )

    def close(self) -> None:
        self._node.destroy_subscription(self._subscription)

    def _policy(self, offers: list[ReliabilityPolicy]) -> ReliabilityPolicy:
        return _common(offers) if self._wanted is None else self._wanted

    def _subscribe(self) -> Any:
        qos = QoSProfile(depth=1, history=HistoryPolicy.KEEP_LAST, reliability=self._reliability)
        return self._node.create_subscription(
            self._message_type,
            endpoint_name(self._node, self._topic),
            self._take,
            qos,
            qos_overriding_options=overriding_options(self._node, self._topic),
        )

    def _offers(self) -> list[ReliabilityPolicy]:
        """The reliability that each publisher of the topic offers."""
        publishers = self._node.get_publishers_info_by_topic(full_name(self._node, self._topic))
        self._single_publisher = len(publishers) <= 1  # none: not discovered yet
        return [info.qos_profile.reliability for info in publishers]

    def _take(self, message: Image | CompressedImage, info: dict[str, int]) -> None:
        number = info["publication_sequence_number"]
        if self._single_publisher and self._sequence_number is not None and number > self._sequence_number:
            self.lost += number - self._sequence_number - 1
        self._sequence_number = number
        self._last_frame_s = time.monotonic()
        self._received += 1
        self._on_frame(ReceivedFrame(message, self._last_frame_s))


def _common(offers: list[ReliabilityPolicy]) -> ReliabilityPolicy:
    """Reliable when every publisher is; best effort, which matches all, otherwise."""
    reliable = bool(offers) and all(offer is ReliabilityPolicy.RELIABLE for offer in offers)
    return ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT
