"""Detection in the images of one camera while the node is active."""

from __future__ import annotations

from collections.abc import Iterator

from rclpy.lifecycle import LifecycleNode

from yolov5_lifecycle.collecting.camera_collecting import CameraCollecting
from yolov5_lifecycle.collecting.collector import Collector
from yolov5_lifecycle.collecting.triggers import CollectRules
from yolov5_lifecycle.detection.nms import Selection
from yolov5_lifecycle.detection.selection import selection
from yolov5_lifecycle.ros.detector.depth_input import DepthInput
from yolov5_lifecycle.ros.detector.image_input import ImageInput, ImageLosses, InputStatus, ReceivedFrame
from yolov5_lifecycle.ros.detector.image_topic import ImageTopic
from yolov5_lifecycle.ros.detector.outputs import Outputs
from yolov5_lifecycle.ros.detector.pipeline import CameraPipeline, DetectedFrame, LastImage
from yolov5_lifecycle.settings.schema import Change
from yolov5_lifecycle.settings.settings import Settings
from yolov5_lifecycle.streaming.frame_statistics import EmptyFrames, EmptyRun, LatencyWindow
from yolov5_lifecycle.streaming.pipeline import Networks
from yolov5_lifecycle.streaming.worker import Feed
from yolov5_lifecycle.tracking.byte_tracker import StampCounts
from yolov5_lifecycle.tracking.tracked_detection import TrackedDetection


class Stream:
    """Owns a camera's subscriptions, tracker and statistics; gives its frames to the inference thread.

    `camera`: see `of_camera`. `settings` are those of the camera. `track_ids` numbers the tracks of all
    cameras; `collector` keeps their images, None if there is no folder for them. Detects with `networks`
    from construction on.

    If the subscription cannot be created, this stays in `problem`; every `look` retries.
    """

    def __init__(
        self,
        node: LifecycleNode,
        camera: str,
        *,
        settings: Settings,
        networks: Networks,
        topic: ImageTopic,
        outputs: Outputs,
        feed: Feed[ReceivedFrame, DetectedFrame],
        last_image: LastImage,
        track_ids: Iterator[int],
        collector: Collector | None,
    ) -> None:
        self._node = node
        self._camera = camera
        self._settings = settings
        self._networks = networks
        self._topic = topic
        self._outputs = outputs
        self._feed = feed
        self._last_image = last_image
        self._track_ids = track_ids
        self._collector = collector
        self._stamps = StampCounts()
        self._told_jumps = 0
        self._tracking = TrackedDetection.started(settings, track_ids, self._stamps)
        self.collecting: CameraCollecting | None = None
        """None while no images are kept."""
        self._input: ImageInput | None = None
        self.losses = ImageLosses()
        self.latencies = LatencyWindow()
        self.empty_frames = _no_empty_frames(settings)
        self.depth: DepthInput | None = None
        topic.follow(settings.image_transport)
        self._start()

    @property
    def tracker_values(self) -> dict[str, str]:
        """For diagnostics: the tracker and its tracks after the last image; empty without one."""
        if self._tracking is None:
            return {}
        return {
            "tracker": self._settings.tracker,
            "confirmed tracks": str(self._tracking.tracker.confirmed),
            "late images not tracked": str(self._stamps.late),
            "jumps back in time": str(self._stamps.jumps),
        }

    @property
    def segments(self) -> bool:
        """Whether the model segments."""
        return bool(self._networks.whole.segments)

    @property
    def problem(self) -> str:
        """Why subscribing to the images failed, "" if it did not."""
        return self._input.problem if self._input else ""

    def look(self) -> InputStatus | None:
        """Update the subscription to what the publishers offer; return its status, None without one.

        Tells how far the stamps went back, if they have since the last look.
        """
        self._tell_jumps()
        self.follow_subscribers()
        status = self._input.look() if self._input else None
        return None if self.problem else status

    def apply(
        self,
        settings: Settings,
        networks: Networks,
        *,
        is_other_model: bool,
    ) -> None:
        """Change to `settings` and `networks` from the next frame on; do nothing if both are the same.

        `is_other_model`: what was found before is not comparable, so there is another tracker.
        """
        if settings == self._settings and networks is self._networks:
            return
        before, self._settings = self._settings, settings
        is_other_camera = before.image_transport != settings.image_transport
        self._networks = networks
        if is_other_camera or is_other_model or before.tracker != settings.tracker:
            self._tracking = TrackedDetection.started(settings, self._track_ids, self._stamps)
        elif self._tracking is not None:
            self._tracking = self._tracking.with_settings(settings)
        if is_other_model:
            self.collecting = None
        self.empty_frames = _no_empty_frames(settings)
        self._start()
        is_resubscribed = bool(before.differing(settings, Change.RESUBSCRIBE))
        if is_resubscribed:
            self.unsubscribe()
            self._topic.follow(settings.image_transport)
        if is_other_camera:
            self.losses.stop()
        if (
            is_resubscribed
            or is_other_model
            or (before.lazy, before.collect) != (settings.lazy, settings.collect)
        ):
            self.follow_subscribers()

    def follow_subscribers(self) -> None:
        """Subscribe if frames are needed; unsubscribe if `lazy` and the outputs have no subscriber."""
        is_lazy, outputs = self._settings.lazy, self._outputs
        subscribers_3d = outputs.subscribers_3d if self._settings.depth else 0
        mask_subscribers = outputs.mask_subscribers if self.segments else 0
        subscribers = outputs.subscribers + mask_subscribers + subscribers_3d
        wanted = not is_lazy or self._settings.collect or subscribers > 0
        if wanted and self._input is None:
            self._input = ImageInput(
                self._node,
                topic=self._topic,
                reliability=self._settings.image_reliability,
                on_frame=self._feed.offer,
                losses=self.losses,
            )
        elif not wanted:
            self.unsubscribe()
            self.losses.stop()
        if self.depth is not None and wanted:
            viewers = subscribers_3d + outputs.image_subscribers
            self.depth.follow(is_needed=not is_lazy or viewers > 0)

    def _tell_jumps(self) -> None:
        jumps = self._stamps.jumps - self._told_jumps
        if jumps == 0:
            return
        self._told_jumps += jumps
        whose, often = f"{self._camera}: " if self._camera else "", f" {jumps} times" if jumps > 1 else ""
        self._node.get_logger().warning(
            f"{whose}the stamps of the images went back{often} by {self._stamps.last_jump_s:.1f} s: tracking "
            "begins anew. This is right if a recording or the simulation began again; otherwise look for a "
            "second publisher or a clock that was set"
        )

    def _start(self) -> None:
        settings = self._settings
        selected = selection(settings, self._networks.whole.class_names)
        self._follow_depth()
        self._follow_collecting(selected)
        pipeline = CameraPipeline(
            networks=self._networks,
            selection=selected,
            outputs=self._outputs,
            latencies=self.latencies,
            empty_frames=self.empty_frames,
            last_image=self._last_image,
            placing=self.depth.placing if self.depth else None,
            tracking=self._tracking,
            collecting=self.collecting,
        )
        self._feed.start(pipeline, max_rate_hz=settings.max_rate)

    def _follow_collecting(self, selected: Selection) -> None:
        """Start or stop looking at frames that may be worth a label, or change the rules."""
        if not self._settings.collect or self._collector is None:
            self.collecting = None
            return
        rules = CollectRules(
            settings=self._settings,
            selection=selected,
            camera=self._camera,
            class_names=self._networks.whole.class_names,
            segments=self.segments,
            weights_sha256=self._networks.weights_sha256,
        )
        self.collecting = self.collecting or CameraCollecting(self._collector, rules)
        self.collecting.rules = rules

    def _follow_depth(self) -> None:
        """Start or stop placing detections; restart if the slop changed."""
        slop_s = self._settings.depth_slop_s if self._settings.depth else None
        if slop_s == (self.depth.slop_s if self.depth else None):
            return
        if self.depth is not None:
            self.depth.follow(is_needed=False)
        self.depth = None if slop_s is None else DepthInput(self._node, camera=self._camera, slop_s=slop_s)

    def unsubscribe(self) -> None:
        """Receive no more images; the caller stops the feed."""
        if self.depth is not None:
            self.depth.follow(is_needed=False)
        if self._input is not None:
            self._input.close()
            self._input = None


def _no_empty_frames(settings: Settings) -> EmptyFrames:
    has_class_thresholds = bool(settings.class_thresholds)
    return EmptyFrames(EmptyRun(settings.confidence_threshold, has_class_thresholds=has_class_thresholds))
