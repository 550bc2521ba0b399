"""A camera of the node: one that `cameras` names, or the only one."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence

from rclpy.lifecycle import LifecycleNode

from yolov5_lifecycle.collecting.collector import Collector
from yolov5_lifecycle.ros.detector.camera_status import CameraStatus
from yolov5_lifecycle.ros.detector.frame_failures import FrameFailures
from yolov5_lifecycle.ros.detector.image_input import ReceivedFrame
from yolov5_lifecycle.ros.detector.image_topic import ImageTopic, Transport
from yolov5_lifecycle.ros.detector.outputs import Outputs
from yolov5_lifecycle.ros.detector.pipeline import DetectedFrame, LastImage
from yolov5_lifecycle.ros.detector.stream import Stream
from yolov5_lifecycle.settings.settings import Settings
from yolov5_lifecycle.streaming.frame_statistics import FrameBalance
from yolov5_lifecycle.streaming.pipeline import Networks
from yolov5_lifecycle.streaming.worker import Worker


class DetectorCamera:
    """Owns a camera's frame balance and topic until `close`, and its publishers and stream while needed.

    `name` is "" for the one camera of a node without `cameras`; `names()` returns those of all cameras.
    `on_subscribers_changed()` is called in the executor, see `Outputs`.
    """

    def __init__(
        self,
        node: LifecycleNode,
        name: str,
        *,
        names: Callable[[], Sequence[str]],
        worker: Worker[ReceivedFrame, DetectedFrame],
        failures: FrameFailures,
        track_ids: Iterator[int],
        collector: Collector | None,
    ) -> None:
        self._node = node
        self.name = name
        self._failures = failures.of_camera(name)
        self._feed = worker.feed(on_failure=self._failures.failed, on_success=self._failures.succeeded)
        self._topic = ImageTopic(node, "raw", camera=name, cameras=names)
        self._track_ids = track_ids
        self._collector = collector
        self.last_image = LastImage()
        self._outputs: Outputs | None = None
        self.stream: Stream | None = None

    def configure(self) -> None:
        """Create the publishers unless they exist; raises rclpy's exception."""
        if self._outputs is None:
            self._outputs = Outputs(
                self._node, camera=self.name, on_subscribers_changed=self.follow_subscribers
            )

    def start(self, settings: Settings, networks: Networks) -> None:
        """Create `stream`: start detecting with these settings of the camera."""
        assert self._outputs is not None, "only a configured camera is activated"
        self.stream = Stream(
            self._node,
            self.name,
            settings=settings,
            networks=networks,
            topic=self._topic,
            outputs=self._outputs,
            feed=self._feed,
            last_image=self.last_image,
            track_ids=self._track_ids,
            collector=self._collector,
        )

    def follow_subscribers(self) -> None:
        """Subscribe or unsubscribe, depending on the subscribers of the outputs."""
        if self.stream is not None:
            self.stream.follow_subscribers()

    def collect_next(self) -> bool:
        """Keep the next image; False if this camera collects none."""
        if self.stream is None or self.stream.collecting is None:
            return False
        self.stream.collecting.request()
        return True

    def unsubscribe(self) -> None:
        """End the stream; the caller stops the feed, alone or together with those of the other cameras."""
        if self.stream is not None:
            self.stream.unsubscribe()
            self.stream = None

    def release(self) -> None:
        """Destroy the publishers; call when no frame is in progress."""
        if self._outputs is not None:
            self._outputs.close()
            self._outputs = None

    def close(self) -> None:
        """End for good; call when no frame is in progress."""
        self.unsubscribe()
        self._feed.close()
        self.release()

    def balance(self) -> FrameBalance:
        """Counts of the frames since the camera was named in `cameras`."""
        return self._feed.balance()

    def status(self, transport: Transport) -> CameraStatus:
        """Snapshot; updates the subscription to what the publishers offer.

        `transport` is the setting `image_transport` of this camera.
        """
        stream = self.stream
        if stream is None:
            self._topic.follow(transport)
        topic = self._topic.look()
        image_input = stream.look() if stream else None
        return CameraStatus(
            camera=self.name,
            problem=stream.problem if stream else "",
            last_problem=self._failures.last_problem,
            recent_failure=self._failures.recent(),
            balance=self._feed.balance(),
            topic=topic,
            input=image_input,
            lost=stream.losses.lost if stream else None,
            overtaken=stream.losses.overtaken if stream else None,
            latency=stream.latencies.summary(time.monotonic()) if stream else None,
            empty=stream.empty_frames.run if stream else None,
            tracking=stream.tracker_values if stream else {},
            depth_status=stream.depth.look() if stream and stream.depth else None,
            subscribers_3d=self._outputs.subscribers_3d if self._outputs else 0,
            segments=stream.segments if stream else False,
            mask_subscribers=self._outputs.mask_subscribers if self._outputs else 0,
            busy_s=self._feed.busy_s(),
            collecting_problem=self._collector.status.problem
            if self._collector and stream and stream.collecting
            else "",
        )
