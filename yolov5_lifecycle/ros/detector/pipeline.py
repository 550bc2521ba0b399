"""Path of one frame: image message in, result messages out."""

from __future__ import annotations

import time
from dataclasses import dataclass

from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.detection.detector import USUAL_SOURCE_HW, Detector
from yolov5_lifecycle.detection.draw import annotate
from yolov5_lifecycle.detection.nms import Selection
from yolov5_lifecycle.images.image import ColourImage
from yolov5_lifecycle.ros import messages
from yolov5_lifecycle.ros.detector.image_input import ReceivedFrame
from yolov5_lifecycle.ros.detector.outputs import Outputs
from yolov5_lifecycle.streaming.frame_statistics import EmptyFrames, LatencyWindow
from yolov5_lifecycle.tracking.tracked_detection import TrackedDetection


@dataclass(frozen=True)
class DetectedFrame:
    """A frame with its image and what was detected in it."""

    frame: ReceivedFrame
    image: ColourImage
    detections: Detections


@dataclass
class LastImage:
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
    last_image: LastImage
    tracking: TrackedDetection | None = None

    def detect(self, frame: ReceivedFrame) -> DetectedFrame:
        """Read the image and detect objects in it. Raises ImageError for an unreadable image."""
        image = messages.image_of_message(frame.message)
        self.last_image.size_hw = image.size_hw
        if self.tracking is None:
            detections = self.detector.detect(image, self.selection)
        else:
            stamp_s = messages.stamp_s(frame.message.header)
            detections = self.tracking.detect(self.detector, image, self.selection, stamp_s)
        return DetectedFrame(frame, image, detections)

    def publish(self, result: DetectedFrame) -> None:
        """Publish the detections and, if it has subscribers, the annotated image."""
        detections, header = result.detections, result.frame.message.header
        class_names = self.detector.class_names
        self.outputs.detections.publish(messages.detection_array(detections, class_names, header))
        now_s = time.monotonic()
        self.latencies.add(now_s, (now_s - result.frame.received_s) * 1e3)
        self.empty_frames.add(now_s, len(detections), detections.best_missed)
        if self.outputs.image_subscribers:
            drawn = annotate(result.image, detections, class_names)
            self.outputs.publish_image(ColourImage(drawn, result.image.order), header)
