"""Snapshot of a camera of the node, with hints on why nothing is detected in its images."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from rclpy.qos import ReliabilityPolicy

from yolov5_lifecycle.detection.nms import WORTH_TELLING
from yolov5_lifecycle.ros.detector.camera_topic import DISCOVERY_S, TopicStatus
from yolov5_lifecycle.ros.detector.depth import DepthStatus
from yolov5_lifecycle.ros.detector.image_input import InputStatus
from yolov5_lifecycle.ros.topics import DETECTIONS, DETECTIONS_3D, IMAGE, MASKS, of_camera
from yolov5_lifecycle.settings.settings import Settings
from yolov5_lifecycle.streaming.frame_statistics import EmptyRun, FrameBalance, LatencySummary, Outcome

MANY_LOST = 4
"""More than one image lost per this many received is reported, given at least FEWEST_IMAGES."""
FEWEST_IMAGES = 10
"""Min number of images for a meaningful loss ratio."""
DEFAULT_SEGMENT_BYTES = 512 * 1024
"""Shared-memory segment that Fast DDS reserves per process without config/shm.xml."""
SILENCE_S = 2.0
"""A camera that publishes no image for longer than this is reported."""
EMPTY_S = 10.0
"""A run of frames without detections for longer than this is reported."""
SLOW_S = 2.0
"""Inference of one image that takes longer than this is reported."""


@dataclass(frozen=True)
class CameraStatus:
    """Snapshot of a camera.

    `camera`: its name in `cameras`, "" without one. `problem`: why it cannot be subscribed to, "" if it can.
    `last_problem`: of its frames; `recent_failure`: the same while it lasts.
    `topic`: the expected image topic, in every state; `input`: the subscription to it, None without one.
    `lost`, `dropped_in_queue`: images sent but not received since activation, as counted by `ImageLosses`.
    `settings`, `latency`, `empty`: while active. `tracking`: values of the tracker, empty without one.
    `depth_status`: while active with the setting `depth`. `subscribers_3d`: subscriptions to detections in
    space. `segments`: whether there is a model and it segments. `mask_subscribers`: subscriptions to masks.
    `busy_s`: time that inference has spent on the current image, in seconds. `collecting_problem`: why no
    images are kept although they should be, else "".
    """

    camera: str
    last_problem: str
    recent_failure: str
    balance: FrameBalance
    topic: TopicStatus
    subscribers_3d: int
    mask_subscribers: int
    settings: Settings | None = None
    problem: str = ""
    input: InputStatus | None = None
    lost: int | None = None
    dropped_in_queue: int | None = None
    latency: LatencySummary | None = None
    empty: EmptyRun | None = None
    tracking: Mapping[str, str] = field(default_factory=dict)
    depth_status: DepthStatus | None = None
    segments: bool = False
    busy_s: float = 0.0
    collecting_problem: str = ""

    @property
    def hint(self) -> str:
        """The problem that leaves the camera of an active node without output, "" if there is none."""
        if self.input is None:
            return ""
        if self.busy_s > SLOW_S:
            return (
                f"inference of one image takes more than {SLOW_S:g} s, {self.busy_s:.0f} s so far. "
                "If inference hangs, deactivate and activate the node; if the model is too slow, use a "
                "smaller image_size or model"
            )
        if self.topic.publishers == 0:
            return _missing(self.topic) if self.topic.missing_s > DISCOVERY_S else ""
        if self.input.reliability is ReliabilityPolicy.RELIABLE and any(
            offer.reliability is ReliabilityPolicy.BEST_EFFORT for offer in self.topic.offers
        ):
            return (
                f"a best-effort publisher on {self.topic.name} does not match this reliable subscription: "
                "set image_reliability to auto or best_effort"
            )
        if self.input.silent_s > SILENCE_S:
            silent_s = f"{self.input.silent_s:.0f} s"
            return f"no image on {self.topic.name} for {silent_s}, although the topic has a publisher"
        if _has_many_lost(self.input):
            return _losses(self.input)
        if self.recent_failure:
            return self.recent_failure
        if self.collecting_problem:
            return f"no images are collected: {self.collecting_problem}"
        return self.depth_status.hint if self.depth_status else ""

    @property
    def remark(self) -> str:
        """Why the camera of an active node has no output although nothing is wrong; else ""."""
        if self.input is None and self.problem:
            return ""
        if self.subscribers_3d and self.depth_status is None:
            topic = of_camera(DETECTIONS_3D, self.camera)
            return f"{topic} has a subscriber, but nothing is published on it: set depth to true"
        if self.mask_subscribers and not self.segments:
            topic = of_camera(MASKS, self.camera)
            return (
                f"{topic} has a subscriber, but the loaded model does not segment: load a segmentation "
                "model, such as yolov5n-seg.pt, with weights"
            )
        if self.input is None:
            outputs = " or ".join(of_camera(topic, self.camera) for topic in (DETECTIONS, IMAGE))
            idle = f"idle (lazy): no subscribers to {outputs}, so no images are received"
            is_missing = self.topic.publishers == 0 and self.topic.missing_s > DISCOVERY_S
            return f"{idle}; {_missing(self.topic)}" if is_missing else idle
        if self.topic.publishers == 0:
            return f"waiting for a publisher of images on {self.topic.name}"
        return _emptiness(self.empty, self.settings) if self.empty and self.settings else ""

    def values(self) -> dict[str, str]:
        """All values as strings, for diagnostics."""
        values = {"last problem": self.problem or self.last_problem} if self.camera else {}
        values |= {f"frames {outcome.value}": str(self.balance[outcome]) for outcome in Outcome}
        values |= {"frames received": str(self.balance.received), "frames pending": str(self.balance.pending)}
        values |= {"image topic": self.topic.name, "image publishers": str(self.topic.publishers)}
        values["other topics with images"] = ", ".join(self.topic.similar)
        if self.input is not None:
            values["image reliability"] = self.input.reliability.name.lower()
        if self.lost is not None:
            values |= {"frames lost": str(self.lost), "frames overtaken": str(self.dropped_in_queue)}
        if self.latency is not None:
            values["rate Hz"] = f"{self.latency.rate_hz:.1f}"
            values["latency median ms"] = f"{self.latency.median_ms:.1f}"
            values["latency p95 ms"] = f"{self.latency.p95_ms:.1f}"
        if self.empty is not None:
            values["empty frames in a row"] = str(self.empty.frames)
            values["best score in them"] = f"{self.empty.best_missed:.2g}"
        return values | dict(self.tracking) | (self.depth_status.values() if self.depth_status else {})


def _emptiness(empty: EmptyRun, settings: Settings) -> str:
    """Report a long run of frames without detections."""
    if empty.duration_s <= EMPTY_S:
        return ""
    if empty.best_filtered:
        return (
            f"Objects are found (best {empty.best_filtered:.2g}), but all are filtered out: check regions, "
            "ignore_regions, min_box_size, max_box_size"
        )
    if not empty.best_missed:
        return (
            f"No detection in {empty.frames} frames: no score above {WORTH_TELLING:g}. Check the images, "
            "image_size and weights, or clear classes"
        )
    also, plural = (" and class_thresholds", "s") if settings.class_thresholds else ("", "")
    return (
        f"No detection in {empty.frames} frames: best score {empty.best_missed:.2g}, confidence_threshold "
        f"{settings.confidence_threshold:g}{also}. Lower the threshold{plural}, or clear classes"
    )


def _missing(topic: TopicStatus) -> str:
    """Explain that `topic` has no publisher, and suggest a remedy."""
    others = f" (but {', '.join(topic.other_types)})" if topic.other_types else ""
    text = f"no publisher of images on {topic.name}{others}"
    if topic.sent_as:
        return f"{text}. They are published in another form, on {topic.sent_as}: {topic.remedy}"
    text = f"{text}: start the camera or remap the topic"
    if not topic.similar:
        return text
    then = f" For {topic.similar[0]}, {topic.remedy}" if topic.remedy else ""
    similar = " and ".join(topic.similar)
    return f"{text}. " + f"Images are published on {similar}: did you mean that?{then}"


def _has_many_lost(recent: InputStatus) -> bool:
    total = recent.received + recent.lost
    return total >= FEWEST_IMAGES and recent.lost > recent.received / MANY_LOST


def _losses(recent: InputStatus) -> str:
    lost = (
        f"{recent.lost} of {recent.received + recent.lost} images were lost between the camera and this node "
        f"in the last {recent.window_s:.0f} s"
    )
    if recent.max_bytes <= DEFAULT_SEGMENT_BYTES:
        return (
            f"{lost}, because the machine or the link is overloaded. Lower the camera's rate, or send "
            "compressed images"
        )
    return (
        f"{lost}; images of {recent.max_bytes / 1e6:.1f} MB do not fit into the default shared memory of "
        "Fast DDS. If the camera runs on this machine, start the camera with the profile config/shm.xml; "
        "otherwise send compressed images, or lower the camera's rate"
    )
