"""Status of depth, with hints on why detections have no place in space."""

from __future__ import annotations

from dataclasses import dataclass

from yolov5_lifecycle.ros.detector.depth_placing import PlacingCounts, UnplacedRun
from yolov5_lifecycle.ros.detector.image_topic import DISCOVERY_S
from yolov5_lifecycle.spatial.placement import Unplaced

UNPLACED_S = 2.0
"""Images without depth for longer than this are reported."""


@dataclass(frozen=True)
class SourceStatus:
    """A topic of the depth camera: its publishers of the right type, and the seconds without one.

    `problem`: why subscribing failed, "" if it did not. `remedy`: what to type if the images are published in
    another form, on `sent_as`; both "" if they are not.
    """

    name: str
    publishers: int
    missing_s: float
    problem: str = ""
    sent_as: str = ""
    remedy: str = ""


@dataclass(frozen=True)
class DepthStatus:
    """Snapshot of depth, while the setting `depth` is true and the node active.

    `image` and `camera_info` are None while nobody needs depth (lazy). `recently_rejected`: why the last
    depth image or camera_info was rejected, "" if that was long ago.
    """

    image: SourceStatus | None
    camera_info: SourceStatus | None
    counts: PlacingCounts
    run: UnplacedRun | None
    recently_rejected: str

    @property
    def hint(self) -> str:
        """Why nothing is published on ~/detections_3d, "" if there is no reason."""
        for source, what in ((self.image, "depth images"), (self.camera_info, "its camera_info")):
            if source is None:
                return ""
            if source.problem:
                return f"{source.problem}: detections have no place in space"
            if source.publishers == 0 and source.missing_s > DISCOVERY_S:
                where = f" (but in another form on {source.sent_as})" if source.sent_as else ""
                remedy = source.remedy or "start the depth camera, remap the topic or set depth to false"
                return (
                    f"no publisher of {what} on {source.name}{where}: detections have no place in space; "
                    f"{remedy}"
                )
        if self.recently_rejected:
            return f"detections have no place in space: {self.recently_rejected}"
        if self.run is not None and self.run.ended_s - self.run.begun_s > UNPLACED_S:
            return f"detections have no place in space: {self.run.reason}"
        return ""

    def values(self) -> dict[str, str]:
        """All values as strings, for diagnostics."""
        values = {}
        if self.image is not None and self.camera_info is not None:
            values["depth topic"] = self.image.name
            values["depth publishers"] = str(self.image.publishers)
            values["camera_info publishers"] = str(self.camera_info.publishers)
        values["depth images received"] = str(self.counts.depth_images)
        values["depth images rejected"] = str(self.counts.rejected_depth_images)
        values["camera_infos rejected"] = str(self.counts.rejected_camera_infos)
        values["images with depth"] = str(self.counts.placed_images)
        values["images without depth"] = str(self.counts.unplaced_images)
        values["detections placed"] = str(self.counts.placed)
        return values | {
            f"unplaced: {reason.value}": str(self.counts.unplaced[reason]) for reason in Unplaced
        }
