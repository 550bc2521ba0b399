"""Path of one frame: image message in, result messages out."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from std_msgs.msg import Header
from vision_msgs.msg import Detection2DArray

from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.detection.detector import USUAL_SOURCE_HW, Detector
from yolov5_lifecycle.detection.draw import annotate
from yolov5_lifecycle.detection.nms import Selection
from yolov5_lifecycle.images.image import ColourImage
from yolov5_lifecycle.ros import messages
from yolov5_lifecycle.ros.detector.depth_placing import DepthPlacing
from yolov5_lifecycle.ros.detector.image_input import ReceivedFrame
from yolov5_lifecycle.ros.detector.outputs import Outputs
from yolov5_lifecycle.streaming.frame_statistics import EmptyFrames, LatencyWindow
from yolov5_lifecycle.tracking.tracked_detection import TrackedDetection


@dataclass(frozen=True)
class DetectedFrame:
    """A frame with its image and the detections in it, found with `Pipeline.wanted`."""

    frame: ReceivedFrame
    image: ColourImage
    found: Detections


@dataclass
class LastImage:
    """Height and width of the last image, used to warm up new models; initially a common size.

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
    placing: DepthPlacing | None
    """None while the setting `depth` is false."""
    tracking: TrackedDetection | None = None

    def detect(self, frame: ReceivedFrame) -> DetectedFrame:
        """Read the image and detect objects in it. Raises ImageError for an unreadable image."""
        image = self.read(frame)
        return DetectedFrame(frame, image, self.detector.detect(image, self.wanted))

    def read(self, frame: ReceivedFrame) -> ColourImage:
        """The image of `frame`. Raises ImageError for an unreadable one."""
        image = messages.image_of_message(frame.message)
        self.last_image.size_hw = image.size_hw
        if self.placing is not None:
            self.placing.expect(frame.message.header.stamp)
        return image

    @property
    def wanted(self) -> Selection:
        """What the detector should report for the next image.

        With a tracker, also detections that may continue a track; masks while a topic that shows them has a
        subscriber.
        """
        outputs = self.outputs
        with_masks = self.detector.segments and outputs.mask_subscribers + outputs.image_subscribers > 0
        selection = replace(self.selection, with_masks=with_masks)
        return selection if self.tracking is None else self.tracking.wider(selection)

    def publish(self, result: DetectedFrame) -> None:
        """Publish the detections and, to subscribers, their places, masks and annotated image.

        The tracker is updated here: an abandoned frame, which may return at any time, is not published.
        """
        detections, header = result.found, result.frame.message.header
        if self.tracking is not None:
            detections = self.tracking.follow(detections, self.selection, messages.stamp_s(header))
        class_names = self.detector.class_names
        array = messages.detection_array(detections, class_names, header)
        self.outputs.detections.publish(array)
        now_s = time.monotonic()
        self.latencies.add(now_s, (now_s - result.frame.received_s) * 1e3)
        self.empty_frames.add(
            now_s, len(detections), best_missed=detections.best_missed, best_filtered=detections.best_filtered
        )
        has_viewers = self.outputs.image_subscribers > 0
        distances_m = self._publish_3d(array, detections, result.image, has_viewers=has_viewers)
        label_image = self._publish_masks(detections, header, has_viewers=has_viewers)
        if has_viewers:
            drawn = annotate(
                result.image,
                detections,
                class_names,
                distances_m=distances_m,
                label_image=label_image,
                box_filter=self.selection.box_filter,
            )
            self.outputs.publish_image(ColourImage(drawn, result.image.order), header)

    def _publish_3d(
        self, array: Detection2DArray, detections: Detections, image: ColourImage, *, has_viewers: bool
    ) -> Sequence[float | None]:
        """Publish the places of the detections; return their distances in metres, () if nobody needs them.

        An image without depth gets no message: an empty one would mean that there are no objects.
        """
        has_subscribers = self.outputs.subscribers_3d > 0
        if self.placing is None or not (has_subscribers or has_viewers):
            return ()
        placed = self.placing.place(detections.boxes_xyxy, image.size_hw, array.header.stamp)
        if has_subscribers and placed.frame_id is not None:
            self.outputs.detections_3d.publish(
                messages.detection_3d_array_message(array, placed.placements, placed.frame_id)
            )
        return placed.distances_m

    def _publish_masks(
        self, detections: Detections, header: Header, *, has_viewers: bool
    ) -> NDArray[np.uint16] | None:
        """Publish and return which pixels belong to which detection; None if no subscriber needs it.

        A subscriber that joins after the detection may get no masks for this image.
        """
        has_subscribers = self.outputs.mask_subscribers > 0
        label_image = detections.label_image() if has_subscribers or has_viewers else None
        if has_subscribers and label_image is not None:
            self.outputs.publish_masks(label_image, header)
        return label_image
