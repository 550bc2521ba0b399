"""What detects while the node is active: the model, the inference threads, and each camera."""

from __future__ import annotations

import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import KW_ONLY, dataclass, field
from functools import partial

import vision_msgs.msg
from rclpy.lifecycle import LifecycleNode, LifecyclePublisher
from std_msgs.msg import Header

from yolov5_lifecycle.collecting.candidate import CollectRules
from yolov5_lifecycle.collecting.collector import CameraCollecting, Collector
from yolov5_lifecycle.detection.class_filter import class_ids, model_problems, selection_of
from yolov5_lifecycle.detection.messages import label_info
from yolov5_lifecycle.detection.nms import Selection
from yolov5_lifecycle.detection.prepared_model import PreparedModel
from yolov5_lifecycle.printable import in_one_line
from yolov5_lifecycle.ros.detector.camera_topic import RAW, Transport, colour_topic
from yolov5_lifecycle.ros.detector.depth import RECENT_S, DepthInput
from yolov5_lifecycle.ros.detector.image_input import ImageInput
from yolov5_lifecycle.ros.detector.pipeline import CameraPipeline, LastImage, Outputs, PointsWanted
from yolov5_lifecycle.ros.detector.transforms import FrameOutput, TransformInput, frame_problems
from yolov5_lifecycle.runtimes.runtime import DeviceLostError
from yolov5_lifecycle.settings.schema import Problem, SettingsError
from yolov5_lifecycle.settings.settings import Settings
from yolov5_lifecycle.streaming.frame_statistics import EmptyFrames, FrameCounter, LatencyWindow, Outcome
from yolov5_lifecycle.streaming.inference_threads import CameraQueue, InferenceThreads
from yolov5_lifecycle.tracking.byte_tracker import StampCounts, TrackedDetection

REST_TIMEOUT_S = 3.0
"""Max wait for the frame in progress; launch escalates its stop signal after 5 s."""
Preparation = Future[PreparedModel]
"""Once done, holds the model or the exception that explains the failure."""
REFUSALS = (ValueError, OSError, RuntimeError)
"""Exceptions of a preparation with a message for the user; any other is a bug."""
MAX_ABANDONED_SESSIONS = 3
"""Each holds the memory of its model and images; beyond this limit, restart the process."""


@dataclass(eq=False)
class DetectorCamera:
    """What a camera has while it is named: its topic in the ROS graph, the counts of its frames.

    `name` is "" for the one camera of a node without `cameras`; `cameras()` returns the names of all.
    `outputs` are None unless the node is configured, `active` is None unless it is active.
    """

    node: LifecycleNode
    name: str
    cameras: Callable[[], Sequence[str]]
    counter: FrameCounter = field(default_factory=FrameCounter)
    last_image: LastImage = field(default_factory=LastImage)
    outputs: Outputs | None = None
    active: ActiveCamera | None = None
    failed_in_a_row: int | None = None
    """Failed frames up to now, None without a frame since the last activation."""
    # A string only: an exception would keep the model alive through its traceback.
    last_problem: tuple[str, float] = ("", float("-inf"))
    """Of its frames, and when it happened (monotonic seconds)."""

    def __post_init__(self) -> None:
        self.topic = colour_topic(self.node, RAW, camera=self.name, cameras=self.cameras)

    def use(self, transport: Transport) -> None:
        """Expect images on the topic of `transport`."""
        if transport != self.topic.form:
            self.topic = colour_topic(self.node, transport, camera=self.name, cameras=self.cameras)

    def update(self) -> None:
        """Adapt an active camera to the ROS graph; what the middleware refuses is told, and tried again by
        the next call.
        """
        if self.active is None:
            return
        try:
            self.active.update()
        except Exception as error:  # noqa: BLE001 - rclpy raises several types; the others go on
            whose = f" for camera {self.name}" if self.name else ""
            problem = f"cannot subscribe{whose}: {type(error).__name__}: {in_one_line(str(error))}"
            self.last_problem = problem, time.monotonic()
            where = "" if isinstance(error, RuntimeError) else f"\n{traceback.format_exc()}"  # a bug here
            told = f"{problem}; retrying every second{where}"
            self.node.get_logger().error(told, throttle_duration_sec=5.0)

    @property
    def recent_failure(self) -> str:
        """The last problem of its frames while it lasts, else ""."""
        problem, happened_s = self.last_problem
        return problem if time.monotonic() - happened_s < RECENT_S else ""

    def report(self, outcome: Outcome, error: Exception | None) -> None:
        """Handle the end of a frame, in the inference thread: log its problem, throttled."""
        if error is None:
            self.failed_in_a_row = 0
            return
        whose, log = f" of camera {self.name}" if self.name else "", self.node.get_logger()
        if outcome is Outcome.REJECTED:
            self.last_problem = f"images are rejected: {error}", time.monotonic()
            log.warning(f"image{whose} rejected: {error}", throttle_duration_sec=5.0)
            return
        reason = f"{type(error).__name__}: {error}"
        self.last_problem = f"inference fails: {reason}", time.monotonic()
        # Runtimes and libraries raise RuntimeError; anything else is a bug here, so log the traceback.
        told = reason if isinstance(error, RuntimeError) else "".join(traceback.format_exception(error))
        log.error(f"inference{whose} failed: {told}", throttle_duration_sec=5.0)
        self.failed_in_a_row = (self.failed_in_a_row or 0) + 1
        if (active := self.active) is not None:
            active.session.judge(self.failed_in_a_row, active.settings, error, reason)


@dataclass(eq=False)
class ActiveCamera:
    """Owns a camera's subscriptions, tracker and statistics while the node is active.

    `settings` are those of the camera. From construction on the threads of the `session` detect what comes.
    """

    session: Session
    camera: DetectorCamera
    outputs: Outputs
    settings: Settings

    def __post_init__(self) -> None:
        self._queue = CameraQueue(self.camera.counter, self.camera.report)
        self.input = ImageInput(partial(self.session.threads.offer, self._queue))
        self.depth: DepthInput | None = None
        self.frame: FrameOutput | None = None
        self._stamps = StampCounts()
        self._told_jumps = 0
        self._tracking = self._new_tracking()
        self.collecting: CameraCollecting | None = None
        """None unless images that are worth a label are kept."""
        self.latencies = LatencyWindow()
        self._start()

    @property
    def busy_s(self) -> float:
        """Seconds that inference has spent on the current image."""
        return self.session.threads.busy_s(self._queue)

    @property
    def collecting_problem(self) -> str:
        """Why no images are kept although they should be, else ""."""
        collector = self.session.collector if self.collecting else None
        return collector.status.problem if collector else ""

    def update(self) -> None:
        """Adapt the subscriptions to the subscribers of the outputs and to what the publishers offer.

        Tells how far the stamps went back, if they have since the last time.
        """
        self._tell_jumps()
        self.follow_subscribers()
        self.input.update()
        if self.depth is not None:
            self.depth.update()

    def apply(self, settings: Settings, *, is_other_model: bool) -> None:
        """Change to `settings` and the model of the session from the next frame on.

        `is_other_model`: what was found before is not comparable, so there is another tracker.
        """
        before, self.settings = self.settings, settings
        is_other_camera = before.image_transport != settings.image_transport
        if is_other_camera or is_other_model or before.tracker != settings.tracker:
            self._tracking = self._new_tracking()
        elif self._tracking is not None:
            self._tracking = self._tracking.with_settings(settings)
        if is_other_model:
            self.collecting = None
        self._start()
        self.follow_subscribers()

    def follow_subscribers(self) -> None:
        """Subscribe if frames are needed; unsubscribe if `lazy` and the outputs have no subscriber."""
        outputs, is_lazy = self.outputs, self.settings.lazy and not self.settings.collect
        is_needed = not is_lazy or outputs.subscribers(
            with_depth=self.settings.depth, with_masks=self.session.model.detector.segments
        )
        self.input.follow(self.camera.topic if is_needed else None, self.settings.image_reliability)
        if self.depth is not None:
            self.depth.follow(is_needed=not self.settings.lazy or outputs.place_subscribers > 0)
        is_needed = self.frame is not None and any(outputs.subscribers_in_space.values())
        self.session.transforms.follow(self, is_needed=is_needed)

    def unsubscribe(self) -> None:
        """Receive no more images."""
        self.input.follow(None, self.settings.image_reliability)
        if self.depth is not None:
            self.depth.follow(is_needed=False)
        if self.frame is not None:
            self.frame.close()
        self.session.transforms.follow(self, is_needed=False)

    def _new_tracking(self) -> TrackedDetection | None:
        return TrackedDetection.started(self.settings, self.session.track_ids, self._stamps)

    def tracker_values(self) -> dict[str, str]:
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
        self.camera.node.get_logger().warning(
            f"{whose}the stamps of the images went back{often} by {self._stamps.last_jump_s:.1f} s: tracking "
            "begins again. This is right if a recording or the simulation began again; otherwise look for a "
            "second publisher or a clock that was set"
        )

    def _start(self) -> None:
        """Process the next frame with the present settings and model."""
        model, settings = self.session.model, self.settings
        self.camera.use(settings.image_transport)
        class_names = model.detector.class_names
        selected = selection_of(settings, class_names)
        self.empty_frames = EmptyFrames()
        self._follow_depth()
        self._follow_frame()
        self._follow_collecting(selected, model)
        pipeline = CameraPipeline(
            model=model,
            selection=selected,
            outputs=self.outputs,
            latencies=self.latencies,
            empty_frames=self.empty_frames,
            last_image=self.camera.last_image,
            depth=self.depth,
            frame=self.frame,
            points=PointsWanted(class_ids(settings.points_classes, class_names), settings.points_spacing_m),
            tracking=self._tracking,
            collecting=self.collecting,
        )
        self.session.threads.start(self._queue, pipeline, max_rate_hz=settings.max_rate)

    def _follow_collecting(self, selected: Selection, model: PreparedModel) -> None:
        """Start or stop looking at frames that may be worth a label, or change the rules."""
        collector = self.session.collector
        if not self.settings.collect or collector is None:
            self.collecting = None
            return
        rules = CollectRules(
            settings=self.settings,
            selection=selected,
            camera=self.camera.name,
            class_names=model.detector.class_names,
            segments=model.detector.segments,
            weights_sha256=model.weights_sha256,
        )
        self.collecting = self.collecting or CameraCollecting(collector, rules)
        self.collecting.rules = rules

    def _follow_depth(self) -> None:
        """Start or stop placing detections; restart if the slop changed."""
        slop_s = self.settings.depth_slop_s if self.settings.depth else None
        if slop_s == (self.depth.slop_s if self.depth else None):
            return
        if self.depth is not None:
            self.depth.follow(is_needed=False)
        node, camera = self.camera.node, self.camera.name
        self.depth = None if slop_s is None else DepthInput(node, camera=camera, slop_s=slop_s)

    def _follow_frame(self) -> None:
        """Start or stop transforming results in space; begin again for another frame or timeout."""
        settings, frame = self.settings, self.frame
        target, timeout_s = settings.target_frame if settings.depth else "", settings.transform_timeout_s
        if frame is not None and (frame.target_frame, frame.timeout_s) == (target, timeout_s):
            return
        self.frame = None
        if frame is not None:
            frame.close()
        if target:
            transforms, node = self.session.transforms, self.camera.node
            self.frame = FrameOutput(node, transforms, target_frame=target, timeout_s=timeout_s)


@dataclass(eq=False)
class Session:
    """Owns the model and the threads with which all `cameras` detect from `start` to `stop`.

    If a frame hangs, the whole session is abandoned: nothing of it is used again.

    `preparation` is the model, once loaded. `label_info` publishes the class names. `track_ids` numbers the
    tracks of all cameras; `collector` keeps their images, None if there is no folder for them.

    Calls `on_too_many(reason)` when the frames of a camera have failed `max_consecutive_failures` times in a
    row and no other camera's last frame succeeded, and `on_device_lost(reason)` when no further frame can
    succeed. Both run in the executor.
    """

    node: LifecycleNode
    preparation: Preparation
    cameras: Mapping[str, DetectorCamera]
    _: KW_ONLY
    label_info: LifecyclePublisher
    track_ids: Iterator[int]
    collector: Collector | None
    on_too_many: Callable[[str], object]
    on_device_lost: Callable[[str], object]
    transforms: TransformInput
    threads: InferenceThreads = field(default_factory=InferenceThreads)

    @property
    def model(self) -> PreparedModel:
        """The model, loaded; raises what loading it raised."""
        return self.preparation.result()

    @property
    def active(self) -> dict[str, ActiveCamera]:
        """The cameras that detect, by name."""
        return {name: camera.active for name, camera in self.cameras.items() if camera.active}

    def start(self, settings: Settings) -> None:
        """Start detecting; raises what loading raised, SettingsError if the settings do not fit the model."""
        if problems := self.problems(settings, self.model):
            raise SettingsError(problems)
        for name in settings.camera_names:
            camera = self.cameras[name]
            assert camera.outputs is not None, "only a configured camera is activated"
            camera.failed_in_a_row = None
            camera.active = ActiveCamera(self, camera, camera.outputs, settings.for_camera(name))

    def problems(self, settings: Settings, model: PreparedModel) -> list[Problem]:
        """Why it cannot detect with these settings and this model."""
        of_frames = frame_problems(settings, self.transforms.listen)
        return [*model_problems(settings, model.detector.class_names), *of_frames]

    def publish_first(self, settings: Settings) -> None:
        """Subscribe and publish the class names, once the publishers are active."""
        self._publish_label_info(settings)
        for name in self.active:
            self.cameras[name].update()

    def apply(self, settings: Settings, preparation: Preparation) -> None:
        """Change to `settings` and the model of `preparation` from the next frame on.

        The caller closes a replaced model, and applies what was before if this raises.
        """
        before, self.preparation = self.preparation, preparation
        is_other_model = preparation is not before and self._is_other_than(before.result())
        for name, camera in self.active.items():
            of_camera = settings.for_camera(name)
            if preparation is not before or of_camera != camera.settings:
                camera.apply(of_camera, is_other_model=is_other_model)
        self._publish_label_info(settings)

    def judge(self, failures: int, settings: Settings, error: Exception, reason: str) -> None:
        """End detection if `error`, by which so many frames of a camera have failed in a row, asks for it."""
        cameras, executor = self.cameras.values(), self.node.executor
        if executor is None:
            return
        if isinstance(error, DeviceLostError):
            executor.create_task(self.on_device_lost, reason)
        elif failures >= settings.max_consecutive_failures and all(
            camera.failed_in_a_row != 0 for camera in cameras
        ):
            executor.create_task(self.on_too_many, f"{failures} failed frames in a row, the last: {reason}")
            for camera in cameras:
                camera.failed_in_a_row = None

    def stop(self, timeout_s: float) -> bool:
        """Receive no more images, end the threads; False if a frame hangs and was abandoned.

        Waits for the frames in progress, less the time of earlier waits, see `InferenceThreads.rest`.
        """
        for camera in self.active.values():
            camera.unsubscribe()
        has_ended = self.threads.close(timeout_s)  # the last frames may fail, too
        for name in self.active:
            self.cameras[name].active = None
        return has_ended

    def free(self, *, is_at_rest: bool) -> None:
        """Free the model, if it could be loaded; see `PreparedModel.close`."""
        if self.preparation.exception() is None:
            self.model.close(is_at_rest=is_at_rest)

    def _is_other_than(self, before: PreparedModel) -> bool:
        """Whether other detections are to be expected than of `before`: then trackers begin again."""
        model = self.model
        return model.weights_sha256 != before.weights_sha256 or not before.serves(model.settings)

    def _publish_label_info(self, settings: Settings) -> None:
        """The class names of the model, and the threshold of the node."""
        names, header = self.model.detector.class_names, Header(stamp=self.node.get_clock().now().to_msg())
        self.label_info.publish(label_info(names, settings.confidence_threshold, header, vision_msgs.msg))
