"""The loaded model and the cameras that it serves, while the node is active."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from builtin_interfaces.msg import Time
from rclpy.lifecycle import LifecycleNode, LifecyclePublisher
from std_msgs.msg import Header
from vision_msgs.msg import LabelInfo, VisionClass

from yolov5_lifecycle.detection.prepared_model import PreparedModel
from yolov5_lifecycle.detection.selection import model_problems
from yolov5_lifecycle.ros.detector.detector_camera import DetectorCamera
from yolov5_lifecycle.ros.detector.image_input import ReceivedFrame
from yolov5_lifecycle.ros.detector.model_loader import Preparation
from yolov5_lifecycle.ros.detector.pipeline import DetectedFrame
from yolov5_lifecycle.settings.schema import SettingsError
from yolov5_lifecycle.settings.settings import Settings
from yolov5_lifecycle.streaming.pipeline import Networks
from yolov5_lifecycle.streaming.worker import Worker

REST_TIMEOUT_S = 3.0
"""Max wait for the frame in progress; launch escalates its stop signal after 5 s."""


def abandoned(rest_timeout_s: float) -> str:
    """What is reported when a frame hangs for longer than that."""
    return (
        f"inference did not end within {rest_timeout_s:g} s, so the node abandons the thread; the thread's "
        "memory stays in use"
    )


class Session:
    """Owns the model with which all `cameras` detect from `start` to `close`.

    `preparation` is the model, once loaded; `networks` are those of the model, from `start` on. `label_info`
    publishes the class names. `worker` runs the inference of all cameras; a frame in progress is waited for
    `rest_timeout_s`.
    """

    def __init__(
        self,
        node: LifecycleNode,
        *,
        preparation: Preparation,
        cameras: Mapping[str, DetectorCamera],
        label_info: LifecyclePublisher,
        worker: Worker[ReceivedFrame, DetectedFrame],
        rest_timeout_s: float,
    ) -> None:
        self._node = node
        self._cameras = cameras
        self._label_info = label_info
        self._worker = worker
        self._rest_timeout_s = rest_timeout_s
        self.preparation = preparation
        self.networks: Networks | None = None

    @property
    def model(self) -> PreparedModel:
        """The model, loaded; raises what loading it raised."""
        return self.preparation.result()

    def start(self, settings: Settings) -> None:
        """Start detecting; raises what loading raised, SettingsError if the settings do not fit the model."""
        if problems := model_problems(settings, self.model.detector.class_names):
            raise SettingsError(problems)
        self.networks = self._networks_of(self.model)
        for name in settings.camera_names:
            self._cameras[name].start(settings.for_camera(name), self.networks)

    def publish_first(self, settings: Settings) -> None:
        """Subscribe and publish the class names, once the publishers are active."""
        self.publish_label_info(settings)
        for camera in self._cameras.values():
            camera.follow_subscribers()

    def apply(self, settings: Settings, preparation: Preparation) -> None:
        """Change to `settings` and the model of `preparation` from the next frame on.

        The caller closes a replaced model.
        """
        before, self.preparation = self.preparation, preparation
        try:
            self._apply(
                settings,
                is_other_model=preparation is not before and self._is_other_than(before.result()),
            )
        except Exception:
            self.preparation = before
            raise
        self.publish_label_info(settings)

    def rest(self) -> bool:
        """Wait for the frame in progress; return False if a thread hangs, which may still use the model."""
        return self._worker.rest(self._rest_timeout_s) and self._worker.abandoned_threads() == 0

    def publish_label_info(self, settings: Settings) -> None:
        stamp = self._node.get_clock().now().to_msg()
        self._label_info.publish(
            label_info(self.model.detector.class_names, settings.confidence_threshold, stamp)
        )

    def close(self) -> bool:
        """Stop all cameras, free the model; return False if a hung thread was abandoned.

        Waits for the frame in progress, less the time of earlier waits, see `Schedule.wait`.
        """
        for camera in self._cameras.values():
            camera.unsubscribe()
        rested = self._worker.stop(self._rest_timeout_s)
        if self.preparation.exception() is None:
            # A thread of an earlier session may hang in a GPU.
            self.model.close(is_at_rest=rested and self._worker.abandoned_threads() == 0)
        return rested

    def _is_other_than(self, before: PreparedModel) -> bool:
        """Whether other detections are to be expected than of `before`: then trackers begin again."""
        model = self.model
        return model.weights_sha256 != before.weights_sha256 or not before.serves(model.settings)

    def _apply(self, settings: Settings, *, is_other_model: bool) -> None:
        self.networks = self._networks_of(self.model)
        for name in settings.camera_names:
            stream = self._cameras[name].stream
            assert stream is not None, "an active camera has a stream"
            stream.apply(settings.for_camera(name), self.networks, is_other_model=is_other_model)

    def _networks_of(self, model: PreparedModel) -> Networks:
        """Those in use if they are of `model`, else new ones."""
        if self.networks is not None and self.networks.whole is model.detector:
            return self.networks
        return Networks(model.detector, model.lanes.detectors, model.weights_sha256)


def label_info(class_names: Sequence[str], confidence_threshold: float, stamp: Time) -> LabelInfo:
    """LabelInfo message with the class names of the loaded model and the threshold of the node."""
    return LabelInfo(
        header=Header(stamp=stamp),
        class_map=[VisionClass(class_id=index, class_name=name) for index, name in enumerate(class_names)],
        threshold=confidence_threshold,
    )
