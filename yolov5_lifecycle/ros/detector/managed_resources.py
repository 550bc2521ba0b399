"""What the transitions create and release: publishers, model, subscription; and the threads behind them."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable

from rclpy.lifecycle import LifecycleNode

from yolov5_lifecycle.detection.prepared_model import Prepare
from yolov5_lifecycle.process.memory import resident_mb
from yolov5_lifecycle.ros.detector.frame_failures import FrameFailures
from yolov5_lifecycle.ros.detector.image_input import ReceivedFrame
from yolov5_lifecycle.ros.detector.image_topic import ImageTopic
from yolov5_lifecycle.ros.detector.model_loader import ModelLoader, Preparation
from yolov5_lifecycle.ros.detector.outputs import Outputs
from yolov5_lifecycle.ros.detector.pipeline import DetectedFrame, LastImage
from yolov5_lifecycle.ros.detector.session import REST_TIMEOUT_S, Detection
from yolov5_lifecycle.ros.detector.status import Status
from yolov5_lifecycle.ros.parameters import SettingsParameters
from yolov5_lifecycle.streaming.worker import Worker


class ManagedResources:
    """Owns the publishers from `configure` to `release`, the detection from `activate` to `deactivate`.

    The inference thread and the model loader exist from construction to `close`. `on_too_many(reason)` and
    `on_device_lost(reason)` are called in the executor; see `FrameFailures`.
    """

    def __init__(
        self,
        node: LifecycleNode,
        *,
        parameters: SettingsParameters,
        prepare: Prepare,
        on_too_many: Callable[[str], None],
        on_device_lost: Callable[[str], None],
    ) -> None:
        self._node = node
        self._parameters = parameters
        self._failures = FrameFailures(
            node,
            max_consecutive=lambda: parameters.value("max_consecutive_failures"),
            on_too_many=on_too_many,
            on_device_lost=on_device_lost,
        )
        self._worker: Worker[ReceivedFrame, DetectedFrame] = Worker()
        self._feed = self._worker.feed(on_failure=self._failures.failed, on_success=self._failures.succeeded)
        self._topic = ImageTopic(node, "raw")
        self._last_image = LastImage()
        self._track_ids = itertools.count(1)
        self.loader = ModelLoader(node, prepare, last_image=self._last_image, on_device_lost=on_device_lost)
        self.detection: Detection | None = None
        self._outputs: Outputs | None = None
        self._loading_for: Outputs | None = None

    def configure(self) -> None:
        """Create the publishers; raises rclpy's exception."""
        self._outputs = Outputs(self._node, on_subscribers_changed=self._follow_subscribers)

    async def load(self) -> bool:
        """Load the model while other callbacks are served; False if another transition came first.

        Then `detection` exists, and `activate` starts it or raises what loading raised.
        """
        outputs = self._outputs
        if self._loading_for is outputs:
            self._node.get_logger().warning("activate refused: the model is already being loaded")
            return False
        self._loading_for = outputs
        preparation = await self.loader.load(
            lambda: self._parameters.settings() if self._may_activate(outputs) else None
        )
        if self._loading_for is outputs:
            self._loading_for = None
        if preparation is None or outputs is None:
            self._node.get_logger().warning(
                "activate canceled: another transition came while the model was loading"
            )
            return False
        self.detection = self._new_detection(outputs, preparation)
        return True

    def activate(self) -> Detection:
        """Start the loaded detection; if a program triggered the transition without `load`, load now.

        Raises what loading the model raises, and SettingsError if the settings do not fit it.
        """
        assert self._outputs is not None, "rclpy activates only what is configured"
        if self.detection is None:
            preparation = self.loader.begin(self._parameters.settings())
            self.detection = self._new_detection(self._outputs, preparation)
        self.detection.start()
        self._failures.succeeded()
        return self.detection

    def deactivate(self) -> bool:
        """Release the detection; False if its frame hangs and the thread was abandoned."""
        detection, self.detection = self.detection, None
        return detection is None or detection.close()

    def release(self) -> None:
        """Destroy the publishers; call after `deactivate`."""
        if self._outputs is not None:
            self._outputs.close()
            self._outputs = None

    def close(self) -> None:
        """End the threads; those that hang are abandoned and logged."""
        log = self._node.get_logger()
        if not self.loader.close():
            log.warning("a model is still being loaded or freed: its thread is abandoned")
        if not self._worker.close(REST_TIMEOUT_S):
            log.warning("inference has still not finished: its thread is abandoned")

    def abandoned_threads(self) -> int:
        """Number of inference threads that hung and have not ended yet."""
        return self._worker.abandoned_threads()

    def status(self, state: str, problem: str) -> Status:
        """Snapshot of the node in the lifecycle state `state`, with the last `problem` that was reported."""
        detection = self.detection
        if detection is None:
            self._topic.follow(self._parameters.value("image_transport"))
        topic = self._topic.look()
        image_input = detection.look(topic) if detection else None
        return Status(
            state=state,
            problem=problem or (detection.problem if detection else ""),
            balance=self._feed.balance(),
            topic=topic,
            settings=self._parameters.settings() if self._outputs else None,
            model=detection.model if detection else None,
            input=image_input,
            lost=detection.losses.lost if detection else None,
            overtaken=detection.losses.overtaken if detection else None,
            latency=detection.latencies.summary(time.monotonic()) if detection else None,
            empty=detection.empty_frames.run if detection else None,
            tracking=detection.tracker_values if detection else {},
            depth_status=detection.depth.look() if detection and detection.depth else None,
            subscribers_3d=self._outputs.subscribers_3d if self._outputs else 0,
            busy_s=self._feed.busy_s(),
            recently_rejected=self._failures.recent_rejection(),
            abandoned_threads=self._worker.abandoned_threads(),
            resident_mb=resident_mb(),
        )

    def _may_activate(self, outputs: Outputs | None) -> bool:
        """Whether the configuration with `outputs` still exists and is not active."""
        return self._outputs is outputs and self.detection is None

    def _new_detection(self, outputs: Outputs, preparation: Preparation) -> Detection:
        return Detection(
            self._node,
            preparation=preparation,
            settings=self._parameters.settings,
            topic=self._topic,
            outputs=outputs,
            worker=self._worker,
            feed=self._feed,
            last_image=self._last_image,
            track_ids=self._track_ids,
        )

    def _follow_subscribers(self) -> None:
        if self.detection is not None:
            self.detection.follow_subscribers()
