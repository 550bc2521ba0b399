"""Everything that exists only while the node is active."""

from __future__ import annotations

from collections.abc import Callable

from rclpy.lifecycle import LifecycleNode

from yolov5_lifecycle.empty_frames import EmptyFrames
from yolov5_lifecycle.preparation import PreparedModel
from yolov5_lifecycle.rate import LatencyWindow, RateLimit
from yolov5_lifecycle.ros import messages
from yolov5_lifecycle.ros.image_input import ImageInput, InputStatus, ReceivedFrame
from yolov5_lifecycle.ros.last_picture import LastPicture
from yolov5_lifecycle.ros.outputs import Outputs
from yolov5_lifecycle.ros.pipeline import Pipeline
from yolov5_lifecycle.selection import selection
from yolov5_lifecycle.setting import Change
from yolov5_lifecycle.settings import Settings
from yolov5_lifecycle.worker import Worker

REST_TIMEOUT_S = 3.0
"""How long a stop waits for the frame in work; launch kills a process 5 s after it asked it to end."""


class Detection:
    """Owns the model and the image subscription, made in this order and given back in the other.

    `model` and `settings` must agree: no `model_problems`.
    """

    def __init__(
        self,
        node: LifecycleNode,
        *,
        settings: Settings,
        model: PreparedModel,
        outputs: Outputs,
        worker: Worker[ReceivedFrame],
        last_picture: LastPicture,
    ) -> None:
        self._node = node
        self._outputs = outputs
        self._worker = worker
        self._last_picture = last_picture
        self._rate_limit = RateLimit()
        self._lost = 0
        self.latencies = LatencyWindow()
        self.empty_frames = EmptyFrames(settings.confidence_threshold)
        self.model = model
        self.settings = settings
        self._input: ImageInput | None = None
        worker.start(self._pipeline(settings, model))

    def look(self) -> InputStatus | None:
        """Who publishes images now, None while not subscribed; the subscription follows what they offer."""
        return self._input.look() if self._input is not None else None

    def rest(self) -> bool:
        """Wait until the frame in work is done; False when it hangs, which is deactivate's business."""
        return self._worker.rest(REST_TIMEOUT_S)

    def apply(self, settings: Settings, model: PreparedModel) -> None:
        """Obey `settings` with `model` from the next frame on; the caller closes a replaced model."""
        self.empty_frames = EmptyFrames(settings.confidence_threshold)
        self._worker.start(self._pipeline(settings, model))
        resubscribe = self.settings.differing(settings, Change.RESUBSCRIBE)
        self.settings, self.model = settings, model
        if resubscribe:
            self._unsubscribe()
        self.follow_listeners()
        self.publish_label_info()

    def follow_listeners(self) -> None:
        """Subscribe when frames are wanted, unsubscribe when `lazy` and nobody listens."""
        wanted = not self.settings.lazy or self._outputs.listeners > 0
        if wanted and self._input is None:
            self._input = ImageInput(
                self._node,
                transport=self.settings.image_transport,
                reliability=self.settings.image_reliability,
                on_frame=self._offer,
                lost=self._lost,
            )
        elif not wanted:
            self._unsubscribe()

    def publish_label_info(self) -> None:
        self._outputs.label_info.publish(
            messages.label_info(
                self.model.detector.class_names,
                self.settings.confidence_threshold,
                self._node.get_clock().now().to_msg(),
            )
        )

    def close(self) -> bool:
        """Unsubscribe, let the worker rest, free the model; False when inference hung and was given up."""
        self._unsubscribe()
        rested = self._worker.stop(REST_TIMEOUT_S)
        self.model.close(is_at_rest=rested)
        return rested

    def _pipeline(
        self, settings: Settings, model: PreparedModel
    ) -> Callable[[ReceivedFrame], Callable[[], None]]:
        return Pipeline(
            detector=model.detector,
            selection=selection(settings, model.detector.class_names),
            outputs=self._outputs,
            latencies=self.latencies,
            empty_frames=self.empty_frames,
            last_picture=self._last_picture,
        )

    def _offer(self, frame: ReceivedFrame) -> None:
        self._worker.offer(frame, skip=not self._rate_limit.admits(frame.received_s, self.settings.max_rate))

    def _unsubscribe(self) -> None:
        if self._input is not None:
            self._input.close()
            self._lost = self._input.lost
            self._input = None
