"""Detection with identities: the detector also reports lower scores, which may continue a track."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.detection.detector import Detector
from yolov5_lifecycle.detection.nms import Selection, narrowed
from yolov5_lifecycle.images.image import ColourImage
from yolov5_lifecycle.settings.settings import Settings
from yolov5_lifecycle.tracking.byte_tracker import ByteTracker, StampCounts
from yolov5_lifecycle.tracking.camera_motion import CameraMotion


@dataclass(frozen=True)
class TrackedDetection:
    """The tracker of one camera with its current settings; `with_settings` of others keeps the tracks."""

    tracker: ByteTracker
    settings: Settings
    camera: CameraMotion = field(default_factory=CameraMotion)

    @classmethod
    def started(
        cls, settings: Settings, ids: Iterator[int], counts: StampCounts | None = None
    ) -> TrackedDetection | None:
        """Without tracks; None if `settings` ask for no tracker. For `ids` and `counts` see ByteTracker."""
        if settings.tracker == "none":
            return None
        return cls(ByteTracker(ids, counts), settings)

    def with_settings(self, settings: Settings) -> TrackedDetection:
        """The same tracker and tracks with `settings`."""
        return replace(self, settings=settings)

    def detect(
        self, detector: Detector, image: ColourImage, selection: Selection, stamp_s: float
    ) -> Detections:
        """What `detector` finds in `image` with `selection`, and `track_ids`; `stamp_s` in seconds.

        Raises InferenceError like `Detector.detect`.
        """
        return self.follow(detector.detect(image, self.wider(selection)), image, selection, stamp_s)

    def wider(self, selection: Selection) -> Selection:
        """`selection`, extended by what may continue a track."""
        return selection.wider(self.settings.track_low_threshold)

    def follow(
        self, found: Detections, image: ColourImage, selection: Selection, stamp_s: float
    ) -> Detections:
        """The detections that `selection` admits, with `track_ids`.

        `found`: those of the wider selection in `image`.
        """
        camera = None
        if self.settings.track_camera_motion == "off":
            self.camera.reset()
        elif not self.tracker.is_late(stamp_s):
            camera = self.camera.since_last(image, found.boxes_xyxy)
        ids = self.tracker.update(found, stamp_s=stamp_s, settings=self.settings, camera=camera)
        return narrowed(replace(found, track_ids=ids), selection)
