"""Path of one frame: image message in, result messages out."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.detection.detector import USUAL_SOURCE_HW, Detector
from yolov5_lifecycle.detection.draw import annotate
from yolov5_lifecycle.detection.nms import Selection
from yolov5_lifecycle.images.image import Picture
from yolov5_lifecycle.ros import messages
from yolov5_lifecycle.ros.detector.image_input import ReceivedFrame
from yolov5_lifecycle.ros.detector.outputs import Outputs
from yolov5_lifecycle.streaming.empty_frames import EmptyFrames
from yolov5_lifecycle.streaming.rate import LatencyWindow


@dataclass
class LastPicture:
    """Height and width of the last image, used to warm up new models; initially a usual size.

    Written by the inference thread.
    """

    size_hw: tuple[int, int] = USUAL_SOURCE_HW


@dataclass(frozen=True)
class Pipeline:
    """One running configuration; immutable, so each frame uses exactly one. A change creates a new one."""

    detector: Detector
    selection: Selection
    outputs: Outputs
    latencies: LatencyWindow
    empty_frames: EmptyFrames
    last_picture: LastPicture

    def __call__(self, frame: ReceivedFrame) -> Callable[[], None]:
        """Detect; return a function that publishes the result. Raises ImageError for an unreadable image."""
        picture = messages.picture(frame.message)
        self.last_picture.size_hw = picture.size_hw
        detections = self.detector.detect(picture, self.selection)
        return lambda: self._deliver(frame, picture, detections)

    def _deliver(self, frame: ReceivedFrame, picture: Picture, detections: Detections) -> None:
        header, class_names = frame.message.header, self.detector.class_names
        self.outputs.detections.publish(messages.detection_array(detections, class_names, header))
        now_s = time.monotonic()
        self.latencies.add(now_s, (now_s - frame.received_s) * 1e3)
        self.empty_frames.add(now_s, len(detections), detections.best_missed)
        if self.outputs.image_subscribers:
            drawn = annotate(picture, detections, class_names)
            self.outputs.publish_image(Picture(drawn, picture.order), header)
