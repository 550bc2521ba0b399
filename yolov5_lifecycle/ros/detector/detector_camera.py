"""A camera of the node: one that `cameras` names, or the only one."""

from __future__ import annotations

import time
import traceback
from collections.abc import Callable, Iterator, Mapping
from dataclasses import KW_ONLY, dataclass, field, replace
from functools import partial

from rclpy.lifecycle import LifecycleNode
from rclpy.node import Node

from yolov5_lifecycle.collecting.camera_collecting import CameraCollecting
from yolov5_lifecycle.collecting.collector import Collector
from yolov5_lifecycle.collecting.triggers import CollectRules
from yolov5_lifecycle.detection.nms import Selection
from yolov5_lifecycle.detection.prepared_model import PreparedModel
from yolov5_lifecycle.detection.selection import selection
from yolov5_lifecycle.ros.detector.camera_status import CameraStatus
from yolov5_lifecycle.ros.detector.depth import RECENT_S, DepthInput
from yolov5_lifecycle.ros.detector.image_input import ImageInput, ImageLosses
from yolov5_lifecycle.ros.detector.image_topic import ImageTopic, Transport
from yolov5_lifecycle.ros.detector.outputs import Outputs
from yolov5_lifecycle.ros.detector.pipeline import CameraPipeline, LastImage
from yolov5_lifecycle.runtimes.runtime import DeviceLostError
from yolov5_lifecycle.settings.schema import Change
from yolov5_lifecycle.settings.settings import Settings
from yolov5_lifecycle.streaming.frame_statistics import (
    EmptyFrames,
    EmptyRun,
    FrameCounter,
    LatencyWindow,
    Outcome,
)
from yolov5_lifecycle.streaming.inference_threads import CameraQueue, InferenceThreads
from yolov5_lifecycle.tracking.byte_tracker import StampCounts
from yolov5_lifecycle.tracking.tracked_detection import TrackedDetection


@dataclass(eq=False)
class FrameFailures:
    """Logs the problems with frames of `cameras`, throttled, and reports when detection should end.

    Calls `on_too_many(reason)` when the frames of a camera have failed `max_consecutive()` times in a row and
    no other camera's last frame succeeded, and `on_device_lost(reason)` when no further frame can succeed.
    Both run in the executor.
    """

    node: Node
    cameras: Mapping[str, DetectorCamera]
    _: KW_ONLY
    max_consecutive: Callable[[], int]
    on_too_many: Callable[[str], object]
    on_device_lost: Callable[[str], None]

    def restart(self) -> None:
        """Count anew, for example on activation."""
        for camera in self.cameras.values():
            camera.failed_in_a_row = None

    def report(self, camera: DetectorCamera, outcome: Outcome, error: Exception | None) -> None:
        """Handle the end of a frame of `camera`, in the inference thread."""
        if error is None:
            camera.failed_in_a_row = 0
            return
        whose, log = f" of camera {camera.name}" if camera.name else "", self.node.get_logger()
        if outcome is Outcome.REJECTED:
            camera.last_problem = f"images are rejected: {error}", time.monotonic()
            log.warning(f"image{whose} rejected: {error}", throttle_duration_sec=5.0)
            return
        reason = f"{type(error).__name__}: {error}"
        camera.last_problem = f"inference fails: {reason}", time.monotonic()
        # Runtimes and libraries raise RuntimeError; anything else is a bug here, so log the traceback.
        told = reason if isinstance(error, RuntimeError) else "".join(traceback.format_exception(error))
        log.error(f"inference{whose} failed: {told}", throttle_duration_sec=5.0)
        self._count(camera, error, reason)

    def _count(self, camera: DetectorCamera, error: Exception, reason: str) -> None:
        count = camera.failed_in_a_row = (camera.failed_in_a_row or 0) + 1
        if isinstance(error, DeviceLostError):
            self._tell(self.on_device_lost, reason)
        elif count >= self.max_consecutive() and all(
            each.failed_in_a_row != 0 for each in tuple(self.cameras.values())
        ):
            self._tell(self.on_too_many, f"{count} failed frames in a row, the last: {reason}")
            self.restart()

    def _tell(self, what: Callable[[str], object], reason: str) -> None:
        if (executor := self.node.executor) is not None:
            executor.create_task(what, reason)


@dataclass(eq=False)
class DetectorCamera:
    """What a camera has while it is named: its topic in the ROS graph, the counts of its frames.

    `name` is "" for the one camera of a node without `cameras`. `outputs` are None unless the node is
    configured, `stream` is None unless it is active.
    """

    name: str
    topic: ImageTopic
    failures: FrameFailures
    counter: FrameCounter = field(default_factory=FrameCounter)
    last_image: LastImage = field(default_factory=LastImage)
    outputs: Outputs | None = None
    stream: Stream | None = None
    failed_in_a_row: int | None = None
    """Failed frames up to now, None without a frame since the last activation."""
    # A string only: an exception would keep the model alive through its traceback.
    last_problem: tuple[str, float] = ("", float("-inf"))
    """Of its frames, and when it happened (monotonic seconds)."""

    def collect_next(self) -> bool:
        """Keep the next image; False if this camera collects none."""
        if self.stream is None or self.stream.collecting is None:
            return False
        self.stream.collecting.request()
        return True

    def release(self) -> None:
        """Destroy the publishers; call when no frame is in progress."""
        if self.outputs is not None:
            self.outputs.close()
            self.outputs = None

    def update(self, transport: Transport) -> None:
        """Adapt the subscriptions to subscribers and publishers; `transport` is the setting of the camera."""
        if self.stream is None:
            self.topic.follow(transport)
        else:
            self.stream.update()

    def status(self) -> CameraStatus:
        problem, happened_s = self.last_problem
        status = CameraStatus(
            camera=self.name,
            last_problem=problem,
            recent_failure=problem if time.monotonic() - happened_s < RECENT_S else "",
            balance=self.counter.balance(),
            topic=self.topic.look(),
            subscribers_3d=self.outputs.subscribers_3d if self.outputs else 0,
            mask_subscribers=self.outputs.mask_subscribers if self.outputs else 0,
        )
        return self.stream.completed(status) if self.stream else status


@dataclass(eq=False)
class Stream:
    """Owns a camera's subscriptions, tracker and statistics while the node is active.

    `settings` are those of the camera. `track_ids` numbers the tracks of all cameras; `collector` keeps their
    images, None if there is no folder for them. `threads` detect with `model` from construction on.

    If the subscription cannot be created, this is shown in the status; every `update` retries.
    """

    node: LifecycleNode
    camera: DetectorCamera
    outputs: Outputs
    settings: Settings
    model: PreparedModel
    threads: InferenceThreads
    track_ids: Iterator[int]
    collector: Collector | None

    def __post_init__(self) -> None:
        self._queue = CameraQueue(self.camera.counter, partial(self.camera.failures.report, self.camera))
        self._stamps = StampCounts()
        self._told_jumps = 0
        self._tracking = TrackedDetection.started(self.settings, self.track_ids, self._stamps)
        self.collecting: CameraCollecting | None = None
        """None unless images that are worth a label are kept."""
        self._input: ImageInput | None = None
        self._losses = ImageLosses()
        self._latencies = LatencyWindow()
        self._empty_frames = _no_empty_frames(self.settings)
        self._depth: DepthInput | None = None
        self.camera.topic.follow(self.settings.image_transport)
        self._start()

    def completed(self, status: CameraStatus) -> CameraStatus:
        """`status` of the camera with what only an active one has."""
        problem = self._input.problem if self._input else ""
        return replace(
            status,
            problem=problem,
            input=self._input.status() if self._input and not problem else None,
            lost=self._losses.lost,
            dropped_in_queue=self._losses.dropped_in_queue,
            latency=self._latencies.summary(time.monotonic()),
            empty=self._empty_frames.run,
            tracking=self._tracker_values(),
            depth_status=self._depth.status() if self._depth else None,
            segments=self.model.detector.segments,
            busy_s=self.threads.busy_s(self._queue),
            collecting_problem=self.collector.status.problem if self.collector and self.collecting else "",
        )

    def update(self) -> None:
        """Adapt the subscriptions to the subscribers of the outputs and to what the publishers offer.

        Tells how far the stamps went back, if they have since the last time.
        """
        self._tell_jumps()
        self.follow_subscribers()
        if self._input is not None:
            self._input.update()
        if self._depth is not None:
            self._depth.update()

    def apply(self, settings: Settings, model: PreparedModel, *, is_other_model: bool) -> None:
        """Change to `settings` and `model` from the next frame on; do nothing if both are the same.

        `is_other_model`: what was found before is not comparable, so there is another tracker.
        """
        if settings == self.settings and model is self.model:
            return
        before, self.settings, self.model = self.settings, settings, model
        is_other_camera = before.image_transport != settings.image_transport
        if is_other_camera or is_other_model or before.tracker != settings.tracker:
            self._tracking = TrackedDetection.started(settings, self.track_ids, self._stamps)
        elif self._tracking is not None:
            self._tracking = self._tracking.with_settings(settings)
        if is_other_model:
            self.collecting = None
        self._empty_frames = _no_empty_frames(settings)
        self._start()
        is_resubscribed = bool(before.differing(settings, Change.RESUBSCRIBE))
        if is_resubscribed:
            self.unsubscribe()
            self.camera.topic.follow(settings.image_transport)
        if is_other_camera:
            self._losses.stop()
        if (
            is_resubscribed
            or is_other_model
            or (before.lazy, before.collect) != (settings.lazy, settings.collect)
        ):
            self.follow_subscribers()

    def follow_subscribers(self) -> None:
        """Subscribe if frames are needed; unsubscribe if `lazy` and the outputs have no subscriber."""
        is_lazy, outputs = self.settings.lazy, self.outputs
        subscribers_3d = outputs.subscribers_3d if self.settings.depth else 0
        mask_subscribers = outputs.mask_subscribers if self.model.detector.segments else 0
        subscribers = outputs.subscribers + mask_subscribers + subscribers_3d
        wanted = not is_lazy or self.settings.collect or subscribers > 0
        if wanted and self._input is None:
            self._input = ImageInput(
                self.node,
                topic=self.camera.topic,
                reliability=self.settings.image_reliability,
                on_frame=partial(self.threads.offer, self._queue),
                losses=self._losses,
            )
        elif not wanted:
            self.unsubscribe()
            self._losses.stop()
        if self._depth is not None and wanted:
            viewers = subscribers_3d + outputs.image_subscribers
            self._depth.follow(is_needed=not is_lazy or viewers > 0)

    def unsubscribe(self) -> None:
        """Receive no more images."""
        if self._depth is not None:
            self._depth.follow(is_needed=False)
        if self._input is not None:
            self._input.close()
            self._input = None

    def _tracker_values(self) -> dict[str, str]:
        """For diagnostics: the tracker and its tracks after the last image; empty without one."""
        if self._tracking is None:
            return {}
        return {
            "tracker": self.settings.tracker,
            "confirmed tracks": str(self._tracking.tracker.confirmed),
            "late images not tracked": str(self._stamps.late),
            "jumps back in time": str(self._stamps.jumps),
        }

    def _tell_jumps(self) -> None:
        jumps = self._stamps.jumps - self._told_jumps
        if jumps == 0:
            return
        self._told_jumps += jumps
        whose = f"{self.camera.name}: " if self.camera.name else ""
        often = f" {jumps} times" if jumps > 1 else ""
        self.node.get_logger().warning(
            f"{whose}the stamps of the images went back{often} by {self._stamps.last_jump_s:.1f} s: tracking "
            "begins anew. This is right if a recording or the simulation began again; otherwise look for a "
            "second publisher or a clock that was set"
        )

    def _start(self) -> None:
        selected = selection(self.settings, self.model.detector.class_names)
        self._follow_depth()
        self._follow_collecting(selected)
        pipeline = CameraPipeline(
            model=self.model,
            selection=selected,
            outputs=self.outputs,
            latencies=self._latencies,
            empty_frames=self._empty_frames,
            last_image=self.camera.last_image,
            depth=self._depth,
            tracking=self._tracking,
            collecting=self.collecting,
        )
        self.threads.start(self._queue, pipeline, max_rate_hz=self.settings.max_rate)

    def _follow_collecting(self, selected: Selection) -> None:
        """Start or stop looking at frames that may be worth a label, or change the rules."""
        if not self.settings.collect or self.collector is None:
            self.collecting = None
            return
        rules = CollectRules(
            settings=self.settings,
            selection=selected,
            camera=self.camera.name,
            class_names=self.model.detector.class_names,
            segments=self.model.detector.segments,
            weights_sha256=self.model.weights_sha256,
        )
        self.collecting = self.collecting or CameraCollecting(self.collector, rules)
        self.collecting.rules = rules

    def _follow_depth(self) -> None:
        """Start or stop placing detections; restart if the slop changed."""
        slop_s = self.settings.depth_slop_s if self.settings.depth else None
        if slop_s == (self._depth.slop_s if self._depth else None):
            return
        if self._depth is not None:
            self._depth.follow(is_needed=False)
        self._depth = (
            None if slop_s is None else DepthInput(self.node, camera=self.camera.name, slop_s=slop_s)
        )


def _no_empty_frames(settings: Settings) -> EmptyFrames:
    has_class_thresholds = bool(settings.class_thresholds)
    return EmptyFrames(EmptyRun(settings.confidence_threshold, has_class_thresholds=has_class_thresholds))
