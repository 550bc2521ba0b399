"""Detection with identities: a detector that reports what continues a track, too, and then the tracker."""

from __future__ import annotations

from dataclasses import dataclass, replace

from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.detection.detector import Detector
from yolov5_lifecycle.detection.nms import Selection
from yolov5_lifecycle.images.image import ColourImage
from yolov5_lifecycle.settings.settings import Settings
from yolov5_lifecycle.tracking.byte_tracker import ByteTracker
from yolov5_lifecycle.tracking.published import published
from yolov5_lifecycle.tracking.tracker_settings import TrackerSettings


@dataclass(frozen=True)
class TrackedDetection:
    """The tracker of one camera with the settings of now; a change of these makes a new one, same tracker."""

    tracker: ByteTracker
    settings: TrackerSettings

    def detect(
        self, detector: Detector, image: ColourImage, selection: Selection, stamp_s: float
    ) -> Detections:
        """What `detector` finds in `image` with `selection`, and `track_ids`; `stamp_s` in seconds.

        Raises InferenceError like `Detector.detect`.
        """
        lowest = min(selection.confidence_threshold, self.settings.track_low_threshold)
        found = detector.detect(image, replace(selection, confidence_threshold=lowest))
        ids = self.tracker.update(found, stamp_s=stamp_s, settings=self.settings)
        return published(found, ids, selection.confidence_threshold)


def tracker_settings(settings: Settings) -> TrackerSettings:
    """The tracker's part of `settings`."""
    return TrackerSettings(
        track_high_threshold=settings.track_high_threshold,
        track_low_threshold=settings.track_low_threshold,
        track_match_threshold=settings.track_match_threshold,
        track_timeout=settings.track_timeout,
        track_across_classes=settings.track_across_classes,
    )
