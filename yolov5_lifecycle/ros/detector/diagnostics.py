"""The node's status on /diagnostics, in every lifecycle state, and why nothing is detected in images."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Sequence
from dataclasses import KW_ONLY, dataclass
from functools import cached_property

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.qos import ReliabilityPolicy
from std_msgs.msg import Header

from yolov5_lifecycle.collecting.collector import CollectorStatus
from yolov5_lifecycle.detection.nms import WORTH_TELLING
from yolov5_lifecycle.detection.prepared_model import PreparedModel
from yolov5_lifecycle.printable import in_lines
from yolov5_lifecycle.ros.detector.camera_topic import DISCOVERY_S, TopicStatus
from yolov5_lifecycle.ros.detector.image_input import ImageInput
from yolov5_lifecycle.ros.detector.session import ActiveCamera, DetectorCamera
from yolov5_lifecycle.ros.topics import DETECTIONS, IMAGE, MASKS, of_camera
from yolov5_lifecycle.settings.camera_overrides import NODE_STATUS, setting_of
from yolov5_lifecycle.settings.settings import Settings
from yolov5_lifecycle.streaming.frame_statistics import EmptyRun

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
_MAX_VALUE = 5_000
"""Max characters of one value; a path has up to 4096."""
_REPEAT_S = 60.0
"""A reason that recurs within this time is not logged again."""
OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR
DETECTING = "detecting"
_REMEDIES = {
    "unconfigured": ": configure and activate the node to detect",
    "inactive": ": activate the node to detect",
}


@dataclass(frozen=True)
class CameraStatus:
    """Why `camera` has no output, and its values.

    `topic`: the expected image topic, in every state.
    """

    camera: DetectorCamera
    topic: TopicStatus

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
        if failure := self.camera.recent_failure:
            return failure
        if problem := active.collecting_problem:
            return f"no images are collected: {problem}"
        hints = (each.hint for each in (active.depth, active.frame) if each is not None)
        return next(filter(None, hints), "")

    @property
    def remark(self) -> str:
        """Why the camera of an active node has no output although nothing is wrong; else ""."""
        active, outputs, name = self.camera.active, self.camera.outputs, self.camera.name
        if active is None or outputs is None:
            return ""
        in_space = [topic for topic, count in outputs.subscribers_in_space.items() if count]
        if in_space and active.depth is None:
            topic = of_camera(in_space[0], name)
            remedy = f"set {setting_of('depth', name)} to true"
            return f"{topic} has a subscriber, but nothing is published on it: {remedy}"
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
        camera = self.camera
        values = {"last problem": camera.last_problem[0]} if camera.name else {}
        values |= {f"frames {name}": str(count) for name, count in camera.counter.balance().items()}
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
    for part in (active.depth, active.frame):
        values |= part.values() if part is not None else {}
    return values | active.tracker_values()


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


@dataclass(frozen=True)
class Summary:
    """Content of one DiagnosticStatus: ERROR with a problem, WARN with a hint, else OK."""

    name: str
    level: bytes
    message: str
    """In one line: the problem, the hint, why there is no output although nothing is wrong, or DETECTING."""
    values: dict[str, str]


@dataclass(frozen=True)
class Status:
    """Snapshot of the node.

    `problem`: the last reported one. `settings`: from configure on; `model`: while active.
    `cameras`: the named ones, otherwise one with the name ""; none if ROS refuses the names of their topics.
    `abandoned_threads`: threads that hung during deactivate and are still running.
    `resident_mb`: RAM of the process, None if unknown. `collected`: None without `collect_dir`.
    `namesakes`: that other nodes have the name of this one, else "".
    """

    state: str
    problem: str
    settings: Settings | None
    model: PreparedModel | None
    cameras: tuple[CameraStatus, ...]
    abandoned_threads: int
    resident_mb: float | None
    collected: CollectorStatus | None
    namesakes: str = ""

    @property
    def of_node(self) -> Summary:
        """Summary of the node: all values of its only camera, or the first hint of several cameras."""
        level, message, values = OK, self._inactivity or DETECTING, dict[str, str]()
        if each := self.of_cameras:
            values = {"cameras": ", ".join(camera.name for camera in each)}
            if warned := next((camera for camera in each if camera.level == WARN), None):
                level, message = WARN, f"{warned.name}: {warned.message}"
        elif self.cameras:
            one = self._summary(self.cameras[0])
            level, message, values = one.level, one.message, one.values
        if self.namesakes:
            level, message = WARN, self.namesakes
        if self.problem:
            level, message = ERROR, self.problem
        return Summary(NODE_STATUS, level, message, self._values() | values)

    @cached_property  # a camera goes on meanwhile, and all of a message tells the same
    def of_cameras(self) -> list[Summary]:
        """Summary of each named camera."""
        return [self._summary(status) for status in self.cameras if status.camera.name]

    def _summary(self, status: CameraStatus) -> Summary:
        hint = status.hint if self.state == "active" else ""
        message = hint or self._inactivity or status.remark or DETECTING
        return Summary(status.camera.name, WARN if hint else OK, message, status.values())

    @property
    def _inactivity(self) -> str:
        return "" if self.state == "active" else self.state + _REMEDIES.get(self.state, "")

    def _values(self) -> dict[str, str]:
        values = {"state": self.state, "last problem": self.problem}
        values["abandoned threads"] = str(self.abandoned_threads)
        if self.resident_mb is not None:
            values["resident memory MB"] = f"{self.resident_mb:.0f}"
        if self.settings is not None:
            values["configuration"] = self.settings.digest()
        if self.collected is not None:
            values |= _collected(self.collected)
        return values | (self.model.facts if self.model is not None else {})


def _collected(status: CollectorStatus) -> dict[str, str]:
    return {
        "images collected": str(status.kept),
        "images not collected, near duplicates": str(status.duplicates),
        "images not collected, less valuable": str(status.outranked),
        "images not collected, disk slow or failing": str(status.dropped),
        "images in collect_dir": str(status.frames),
        "collect_dir MB": f"{status.megabytes:.1f}",
    }


@dataclass(eq=False)
class Diagnostics:
    """Publishes `status()` every `period_s`; logs namesakes, and why an active node has no output.

    `clock` returns monotonic seconds.
    """

    node: Node
    status: Callable[[], Status]
    _: KW_ONLY
    period_s: float
    clock: Callable[[], float] = time.monotonic

    def __post_init__(self) -> None:
        self._seen_s: dict[tuple[str, str], float] = {}
        """When each message, without numbers, of a name was last seen."""
        self._publisher = self.node.create_publisher(DiagnosticArray, "/diagnostics", 10)
        # Steady time: simulated time may be paused (use_sim_time without /clock).
        self._timer = self.node.create_timer(
            self.period_s, self.publish, clock=Clock(clock_type=ClockType.STEADY_TIME)
        )

    def publish(self) -> None:
        """Publish the current status now and log its reasons if they are new."""
        stamp = self.node.get_clock().now().to_msg()  # nothing in the status is older
        status = self.status()
        of_node, of_cameras = status.of_node, status.of_cameras
        name = self.node.get_fully_qualified_name()
        self._publisher.publish(
            DiagnosticArray(
                header=Header(stamp=stamp),
                status=[diagnostic_status(summary, name) for summary in (of_node, *of_cameras)],
            )
        )
        if status.namesakes:
            self._log_reasons([Summary(NODE_STATUS, WARN, status.namesakes, {})])
        else:
            self._log_reasons(of_cameras or [of_node] if status.state == "active" else [])

    def _log_reasons(self, summaries: Sequence[Summary]) -> None:
        """Log each reason when it begins, unless it ended less than `_REPEAT_S` before.

        A text in which only numbers changed is the same reason.
        """
        log, now_s, names = self.node.get_logger(), self.clock(), {each.name for each in summaries}
        self._seen_s = {
            seen: at_s for seen, at_s in self._seen_s.items() if seen[0] in names and now_s - at_s < _REPEAT_S
        }
        for each in summaries:
            seen = each.name, re.sub(r"[\d.]+", "", each.message)
            whose = "" if each.name in ("", NODE_STATUS) else f"{each.name}: "
            if seen not in self._seen_s and each.level == WARN:
                log.warning(f"{whose}{each.message}")
            elif seen not in self._seen_s and each.level == OK and each.message != DETECTING:
                log.info(f"{whose}{each.message}")
            self._seen_s[seen] = now_s


def diagnostic_status(summary: Summary, node_name: str) -> DiagnosticStatus:
    """Convert `summary` to a DiagnosticStatus."""
    values = [KeyValue(key=key, value=in_lines(value, _MAX_VALUE)) for key, value in summary.values.items()]
    return DiagnosticStatus(
        level=summary.level,
        name=f"{node_name}: {summary.name}",
        message=in_lines(summary.message, _MAX_VALUE),
        hardware_id=node_name,
        values=values,
    )
