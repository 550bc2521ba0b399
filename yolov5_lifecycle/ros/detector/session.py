"""What detects while the node is active: the model, the inference threads, a stream for each camera."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

from builtin_interfaces.msg import Time
from rclpy.lifecycle import LifecycleNode, LifecyclePublisher
from std_msgs.msg import Header
from vision_msgs.msg import LabelInfo, VisionClass

from yolov5_lifecycle.collecting.collector import Collector
from yolov5_lifecycle.detection.prepared_model import PreparedModel
from yolov5_lifecycle.detection.selection import model_problems
from yolov5_lifecycle.ros.detector.detector_camera import DetectorCamera, Stream
from yolov5_lifecycle.ros.detector.model_loader import Preparation
from yolov5_lifecycle.settings.schema import SettingsError
from yolov5_lifecycle.settings.settings import Settings
from yolov5_lifecycle.streaming.inference_threads import InferenceThreads

REST_TIMEOUT_S = 3.0
"""Max wait for the frame in progress; launch escalates its stop signal after 5 s."""
MAX_ABANDONED_SESSIONS = 3
"""Each holds the memory of its model and images; beyond this limit, restart the process."""


def abandoned(rest_timeout_s: float) -> str:
    """What is reported when a frame hangs for longer than that."""
    return (
        f"inference did not end within {rest_timeout_s:g} s, so the node abandons the thread; the thread's "
        "memory stays in use"
    )


@dataclass(eq=False)
class Session:
    """Owns the model and the threads with which all `cameras` detect from `start` to `close`.

    If a frame hangs, the whole session is abandoned: nothing of it is used again.

    `preparation` is the model, once loaded. `label_info` publishes the class names. `track_ids`, `collector`:
    see `Stream`.
    """

    node: LifecycleNode
    preparation: Preparation
    cameras: Mapping[str, DetectorCamera]
    label_info: LifecyclePublisher
    track_ids: Iterator[int]
    collector: Collector | None
    threads: InferenceThreads = field(default_factory=InferenceThreads)

    @property
    def model(self) -> PreparedModel:
        """The model, loaded; raises what loading it raised."""
        return self.preparation.result()

    @property
    def streams(self) -> dict[str, Stream]:
        """Those of the cameras that detect, by name."""
        return {name: camera.stream for name, camera in self.cameras.items() if camera.stream}

    def start(self, settings: Settings) -> None:
        """Start detecting; raises what loading raised, SettingsError if the settings do not fit the model."""
        if problems := model_problems(settings, self.model.detector.class_names):
            raise SettingsError(problems)
        for name in settings.camera_names:
            camera = self.cameras[name]
            assert camera.outputs is not None, "only a configured camera is activated"
            camera.stream = Stream(
                self.node,
                camera,
                camera.outputs,
                settings.for_camera(name),
                self.model,
                self.threads,
                self.track_ids,
                self.collector,
            )

    def publish_first(self, settings: Settings) -> None:
        """Subscribe and publish the class names, once the publishers are active."""
        self._publish_label_info(settings)
        for stream in self.streams.values():
            stream.follow_subscribers()

    def apply(self, settings: Settings, preparation: Preparation) -> None:
        """Change to `settings` and the model of `preparation` from the next frame on.

        The caller closes a replaced model, and applies what was before if this raises.
        """
        before, self.preparation = self.preparation, preparation
        is_other_model = preparation is not before and self._is_other_than(before.result())
        for name, stream in self.streams.items():
            stream.apply(settings.for_camera(name), self.model, is_other_model=is_other_model)
        self._publish_label_info(settings)

    def stop(self, timeout_s: float) -> bool:
        """Receive no more images, end the threads; False if a frame hangs and was abandoned.

        Waits for the frames in progress, less the time of earlier waits, see `InferenceThreads.rest`.
        """
        for name, stream in self.streams.items():
            stream.unsubscribe()
            self.cameras[name].stream = None
        return self.threads.close(timeout_s)

    def free(self, *, is_at_rest: bool) -> None:
        """Free the model, if it could be loaded; see `PreparedModel.close`."""
        if self.preparation.exception() is None:
            self.model.close(is_at_rest=is_at_rest)

    def _is_other_than(self, before: PreparedModel) -> bool:
        """Whether other detections are to be expected than of `before`: then trackers begin again."""
        model = self.model
        return model.weights_sha256 != before.weights_sha256 or not before.serves(model.settings)

    def _publish_label_info(self, settings: Settings) -> None:
        stamp = self.node.get_clock().now().to_msg()
        self.label_info.publish(
            label_info(self.model.detector.class_names, settings.confidence_threshold, stamp)
        )


def label_info(class_names: Sequence[str], confidence_threshold: float, stamp: Time) -> LabelInfo:
    """LabelInfo message with the class names of the loaded model and the threshold of the node."""
    return LabelInfo(
        header=Header(stamp=stamp),
        class_map=[VisionClass(class_id=index, class_name=name) for index, name in enumerate(class_names)],
        threshold=confidence_threshold,
    )
