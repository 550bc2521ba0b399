"""Status of a camera of the node, with hints on why nothing is detected in its images."""

from __future__ import annotations

import time
from dataclasses import dataclass

from rclpy.qos import ReliabilityPolicy

from yolov5_lifecycle.detection.nms import WORTH_TELLING
from yolov5_lifecycle.ros.detector.camera_topic import DISCOVERY_S, TopicStatus
from yolov5_lifecycle.ros.detector.image_input import ImageInput
from yolov5_lifecycle.ros.detector.session import ActiveCamera, DetectorCamera
from yolov5_lifecycle.ros.topics import DETECTIONS, DETECTIONS_3D, IMAGE, MASKS, of_camera
from yolov5_lifecycle.settings.settings import Settings
from yolov5_lifecycle.streaming.frame_statistics import EmptyRun, Outcome

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
    """Why `camera` has no output, and its values.

    `topic`: the expected image topic, in every state.
    """

    camera: DetectorCamera
    topic: TopicStatus

    @property
    def problem(self) -> str:
        """Why the camera cannot be subscribed to, "" if it can."""
        return self.camera.active.input.problem if self.camera.active else ""

    @property
    def hint(self) -> str:
        """The problem that leaves the camera of an active node without output, "" if there is none."""
        active = self.camera.active
        if active is None or active.input.reliability is None:
            return ""
        if (busy_s := active.busy_s) > SLOW_S:
            return (
                f"inference of one image takes more than {SLOW_S:g} s, {busy_s:.0f} s so far. "
                "If inference hangs, deactivate and activate the node; if the model is too slow, use a "
                "smaller image_size or model"
            )
        if self.topic.publishers == 0:
            return _missing(self.topic) if self.topic.missing_s > DISCOVERY_S else ""
        if active.input.reliability is ReliabilityPolicy.RELIABLE and any(
            offer.reliability is ReliabilityPolicy.BEST_EFFORT for offer in self.topic.offers
        ):
            return (
                f"a best-effort publisher on {self.topic.name} does not match this reliable subscription: "
                "set image_reliability to auto or best_effort"
            )
        if (silent_s := active.input.silent_s) > SILENCE_S:
            return f"no image on {self.topic.name} for {silent_s:.0f} s, although the topic has a publisher"
        if losses := _losses(active.input):
            return losses
        if self.camera.recent_failure:
            return self.camera.recent_failure
        if active.collecting_problem:
            return f"no images are collected: {active.collecting_problem}"
        return active.depth.hint if active.depth else ""

    @property
    def remark(self) -> str:
        """Why the camera of an active node has no output although nothing is wrong; else ""."""
        active, outputs, name = self.camera.active, self.camera.outputs, self.camera.name
        if active is None or outputs is None or self.problem:
            return ""
        if outputs.subscribers_3d and active.depth is None:
            topic = of_camera(DETECTIONS_3D, name)
            return f"{topic} has a subscriber, but nothing is published on it: set depth to true"
        if outputs.mask_subscribers and not active.session.model.detector.segments:
            topic = of_camera(MASKS, name)
            return (
                f"{topic} has a subscriber, but the loaded model does not segment: load a segmentation "
                "model, such as yolov5n-seg.pt, with weights"
            )
        if active.input.reliability is None:
            unwatched = " or ".join(of_camera(topic, name) for topic in (DETECTIONS, IMAGE))
            idle = f"idle (lazy): no subscribers to {unwatched}, so no images are received"
            is_missing = self.topic.publishers == 0 and self.topic.missing_s > DISCOVERY_S
            return f"{idle}; {_missing(self.topic)}" if is_missing else idle
        if self.topic.publishers == 0:
            return f"waiting for a publisher of images on {self.topic.name}"
        return _emptiness(active.empty_frames.run, active.settings)

    def values(self) -> dict[str, str]:
        """All values as strings, for diagnostics."""
        camera, balance = self.camera, self.camera.counter.balance()
        values = {"last problem": self.problem or camera.last_problem[0]} if camera.name else {}
        values |= {f"frames {outcome.value}": str(balance[outcome]) for outcome in Outcome}
        values |= {"frames received": str(balance.received), "frames pending": str(balance.pending)}
        values |= {"image topic": self.topic.name, "image publishers": str(self.topic.publishers)}
        values["other topics with images"] = ", ".join(self.topic.similar)
        return values | (_active_values(camera.active) if camera.active else {})


def _active_values(active: ActiveCamera) -> dict[str, str]:
    values, latency, empty = {}, active.latencies.summary(time.monotonic()), active.empty_frames.run
    if active.input.reliability is not None:
        values["image reliability"] = active.input.reliability.name.lower()
    values["frames lost"] = str(active.input.losses.lost)
    values["frames overtaken"] = str(active.input.losses.dropped_in_queue)
    values["rate Hz"] = f"{latency.rate_hz:.1f}"
    values["latency median ms"] = f"{latency.median_ms:.1f}"
    values["latency p95 ms"] = f"{latency.p95_ms:.1f}"
    values["empty frames in a row"] = str(empty.frames)
    values["best score in them"] = f"{empty.best_missed:.2g}"
    return values | active.tracker_values() | (active.depth.values() if active.depth else {})


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


def _losses(received: ImageInput) -> str:
    """Report that many images were lost in the last seconds, else ""."""
    count, lost, window_s = received.recent()
    if count + lost < FEWEST_IMAGES or lost <= count / MANY_LOST:
        return ""
    text = (
        f"{lost} of {count + lost} images were lost between the camera and this node in the last "
        f"{window_s:.0f} s"
    )
    if received.max_bytes <= DEFAULT_SEGMENT_BYTES:
        return (
            f"{text}, because the machine or the link is overloaded. Lower the camera's rate, or send "
            "compressed images"
        )
    return (
        f"{text}; images of {received.max_bytes / 1e6:.1f} MB do not fit into the default shared memory of "
        "Fast DDS. If the camera runs on this machine, start the camera with the profile config/shm.xml; "
        "otherwise send compressed images, or lower the camera's rate"
    )
