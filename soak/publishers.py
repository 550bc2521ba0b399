"""Several image publishers that join, leave and publish simultaneously on one topic."""

from __future__ import annotations

from contextlib import closing

from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Image
from support.detector_process import NODE, scene_image

from soak.finding import Finding, none_wrong_nor_escaped
from soak.sender import Sender
from soak.subject import Subject
from yolov5_lifecycle.ros.observer import Observer

_QUALITIES = [
    QoSProfile(depth=1, reliability=reliability, durability=durability)
    for reliability in (ReliabilityPolicy.RELIABLE, ReliabilityPolicy.BEST_EFFORT)
    for durability in (DurabilityPolicy.VOLATILE, DurabilityPolicy.TRANSIENT_LOCAL)
]


def counted_publishers(subject: Subject, count: int, *, burst: int = 200) -> Finding:
    """Start and stop a second publisher `count` times for each QoS while the first keeps publishing.

    Its bursts push its sequence numbers above those of the first. Counting gaps across the two would report
    more lost images than were ever sent.
    """
    subject.reset()
    assert subject.node.set_parameters(lazy=False) == ""
    subject.bring_to("active")
    sent, problems, image = 0, [], scene_image()
    received_before = int(subject.status()["frames received"])
    with closing(Observer("second", domain=subject.domain)) as second:
        first = Sender(subject, "raw")
        for number in range(count * len(_QUALITIES)):
            quality = _QUALITIES[number % len(_QUALITIES)]
            publisher = second.create_publisher(Image, f"{NODE}/image_raw", quality)
            subject.observer.wait_for(lambda: publisher.get_subscription_count() > 0, "the subscription")  # noqa: B023
            for _ in range(burst):
                publisher.publish(Image())
                first.send(image)
            sent += 2 * burst
            second.destroy_publisher(publisher)
            status = subject.status()
            received = int(status["frames received"]) - received_before
            missed = int(status["frames lost"]) + int(status["frames overtaken"])
            if received + missed > sent:
                problems.append(f"{received} received and {missed} missed of {sent}")
        first.send_whole()
        first.close()
    return none_wrong_nor_escaped(
        "publishers that join and leave are never counted as lost images",
        f"{count * len(_QUALITIES)} second publishers of {len(_QUALITIES)} kinds, {sent} images",
        "wrong counts",
        problems,
        subject.escaped,
        limit="0, 0; detects afterwards",
    )
