"""Model and image subscription, which exist only while the node is active."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TypeVar

from rclpy.lifecycle import LifecycleNode

from yolov5_lifecycle.detection.prepared_model import PreparedModel
from yolov5_lifecycle.detection.selection import model_problems, selection
from yolov5_lifecycle.printable import in_one_line
from yolov5_lifecycle.ros import messages
from yolov5_lifecycle.ros.detector.depth_input import DepthInput
from yolov5_lifecycle.ros.detector.image_input import ImageInput, InputStatus, ReceivedFrame
from yolov5_lifecycle.ros.detector.image_losses import ImageLosses
from yolov5_lifecycle.ros.detector.image_topic import ImageTopic, TopicStatus
from yolov5_lifecycle.ros.detector.model_loader import Preparation
from yolov5_lifecycle.ros.detector.outputs import Outputs
from yolov5_lifecycle.ros.detector.pipeline import DetectedFrame, LastImage, Pipeline
from yolov5_lifecycle.settings.schema import Change, SettingsError
from yolov5_lifecycle.settings.settings import Settings
from yolov5_lifecycle.streaming.feed import Feed
from yolov5_lifecycle.streaming.frame_statistics import EmptyFrames, LatencyWindow
from yolov5_lifecycle.streaming.worker import Worker
from yolov5_lifecycle.tracking.byte_tracker import ByteTracker
from yolov5_lifecycle.tracking.tracked_detection import TrackedDetection, tracker_settings

Made = TypeVar("Made")

REST_TIMEOUT_S = 3.0
"""Max wait for the frame in progress; launch escalates its stop signal after 5 s."""


class Detection:
    """Owns the model and the image subscription, created in this order and released in reverse.

    `preparation` is the model, once loaded. `settings()` returns the current settings. `topic` is the image
    topic. `track_ids` numbers the tracks.

    If the subscription cannot be created, this is logged and stays in `problem`; every `look` retries.
    """

    def __init__(
        self,
        node: LifecycleNode,
        *,
        preparation: Preparation,
        settings: Callable[[], Settings],
        topic: ImageTopic,
        outputs: Outputs,
        worker: Worker[ReceivedFrame, DetectedFrame],
        feed: Feed[ReceivedFrame, DetectedFrame],
        last_image: LastImage,
        track_ids: Iterator[int],
    ) -> None:
        self._node = node
        self._settings = settings
        self._topic = topic
        self._outputs = outputs
        self._worker = worker
        self._feed = feed
        self._last_image = last_image
        self._track_ids = track_ids
        self._tracker: ByteTracker | None = None
        self.losses = ImageLosses()
        self.problem = ""
        self.latencies = LatencyWindow()
        self.empty_frames = EmptyFrames(settings().confidence_threshold)
        self.preparation = preparation
        self._input: ImageInput | None = None
        self.depth: DepthInput | None = None

    @property
    def model(self) -> PreparedModel:
        """The model, loaded; raises what loading it raised."""
        return self.preparation.result()

    @property
    def tracker_values(self) -> dict[str, str]:
        """For diagnostics: the tracker and its tracks after the last image; empty without one."""
        if self._tracker is None:
            return {}
        return {"tracker": self._settings().tracker, "confirmed tracks": str(self._tracker.confirmed)}

    def start(self) -> None:
        """Begin to detect; raises what loading raised, SettingsError if the settings do not fit the model."""
        settings, model = self._settings(), self.model
        if problems := model_problems(settings, model.detector.class_names):
            raise SettingsError(problems)
        self._topic.follow(settings.image_transport)
        self._tracker = self._new_tracker(settings)
        self._start(settings, model)

    def look(self, topic: TopicStatus) -> InputStatus | None:
        """Update the subscription to what the publishers offer; return its status, None without one."""
        self.follow_subscribers()
        if (present := self._input) is None:
            return None
        return self._trying(lambda: present.look(topic))

    def rest(self) -> bool:
        """Wait for the frame in progress; return False if it hangs, which deactivate handles."""
        return self._worker.rest(REST_TIMEOUT_S)

    def apply(self, before: Settings, after: Settings, preparation: Preparation) -> None:
        """Change from settings `before` to `after`, with the model of `preparation`, from the next frame on.

        The caller closes a replaced model.
        """
        self.empty_frames = EmptyFrames(after.confidence_threshold)
        is_other_camera = before.image_transport != after.image_transport
        if is_other_camera or before.tracker != after.tracker or preparation is not self.preparation:
            self._tracker = self._new_tracker(after)
        self._start(after, preparation.result())
        self.preparation = preparation
        is_resubscribed = bool(before.differing(after, Change.RESUBSCRIBE))
        if is_resubscribed:
            self._unsubscribe()
            self._topic.follow(after.image_transport)
        if is_other_camera:
            self.losses.stop()
        if is_resubscribed or before.lazy != after.lazy:
            self.follow_subscribers()
        self.publish_label_info()

    def follow_subscribers(self) -> None:
        """Subscribe if frames are needed; unsubscribe if `lazy` and the outputs have no subscriber."""
        settings = self._settings()
        subscribers_3d = self._outputs.subscribers_3d if settings.depth else 0
        wanted = not settings.lazy or self._outputs.subscribers + subscribers_3d > 0
        if wanted and self._input is None:
            self._input = self._trying(self._subscribed)
        elif not wanted:
            self._unsubscribe()
            self.losses.stop()
        if self.depth is not None and wanted:
            viewers = subscribers_3d + self._outputs.image_subscribers
            self.depth.follow(is_needed=not settings.lazy or viewers > 0)

    def _subscribed(self) -> ImageInput:
        return ImageInput(
            self._node,
            topic=self._topic,
            reliability=self._settings().image_reliability,
            on_frame=self._feed.offer,
            losses=self.losses,
        )

    def _trying(self, subscribe: Callable[[], Made]) -> Made | None:
        """Return `subscribe()`; on an exception return None and set `problem` to the reason."""
        try:
            made = subscribe()
        except Exception as error:  # noqa: BLE001 - rclpy raises several types; reported and retried
            problem = (
                f"cannot subscribe to {self._topic.name}: {in_one_line(str(error))}. Nothing is detected "
                "meanwhile; retrying every second"
            )
            if problem != self.problem:
                self._node.get_logger().error(problem)
            self.problem = problem
            return None
        self.problem = ""
        return made

    def publish_label_info(self) -> None:
        self._outputs.label_info.publish(
            messages.label_info(
                self.model.detector.class_names,
                self._settings().confidence_threshold,
                self._node.get_clock().now().to_msg(),
            )
        )

    def close(self) -> bool:
        """Unsubscribe, stop the worker, free the model; return False if a hung thread was abandoned."""
        self._unsubscribe()
        rested = self._feed.stop(REST_TIMEOUT_S)
        if self.preparation.exception() is None:
            self.model.close(is_at_rest=rested)
        return rested

    def _new_tracker(self, settings: Settings) -> ByteTracker | None:
        return ByteTracker(self._track_ids) if settings.tracker == "bytetrack" else None

    def _start(self, settings: Settings, model: PreparedModel) -> None:
        self._follow_depth(settings)
        tracker = self._tracker
        pipeline = Pipeline(
            detector=model.detector,
            selection=selection(settings, model.detector.class_names),
            outputs=self._outputs,
            latencies=self.latencies,
            empty_frames=self.empty_frames,
            last_image=self._last_image,
            placing=self.depth.placing if self.depth else None,
            tracking=None if tracker is None else TrackedDetection(tracker, tracker_settings(settings)),
        )
        self._feed.start(pipeline, max_rate_hz=settings.max_rate)

    def _follow_depth(self, settings: Settings) -> None:
        """Begin or end to place detections; begin afresh with another slop."""
        slop_s = settings.depth_slop_s if settings.depth else None
        if slop_s == (self.depth.slop_s if self.depth else None):
            return
        if self.depth is not None:
            self.depth.follow(is_needed=False)
        self.depth = None if slop_s is None else DepthInput(self._node, slop_s=slop_s)

    def _unsubscribe(self) -> None:
        if self.depth is not None:
            self.depth.follow(is_needed=False)
        if self._input is not None:
            self._input.close()
            self._input = None
        self.problem = ""
