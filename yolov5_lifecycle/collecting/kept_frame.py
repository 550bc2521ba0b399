"""A candidate as what is written of it: record, JPEG file and labels."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.collecting.candidate import Candidate
from yolov5_lifecycle.collecting.collected_folder import CollectedFolder
from yolov5_lifecycle.collecting.labels import label_text
from yolov5_lifecycle.collecting.reason import Reason, Why, value_of
from yolov5_lifecycle.collecting.record import CollectedFrame, CollectedObject, embedding_text, shades_text
from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.images.compressed import encode_jpeg
from yolov5_lifecycle.images.region import Region


def kept_frame(
    candidate: Candidate, reasons: Mapping[Reason, Why], folder: CollectedFolder
) -> tuple[CollectedFrame, bytes, str]:
    """The record, the JPEG file and the text of the labels of `candidate` in `folder`, kept for `reasons`.

    What lies in a blank region is neither visible nor labelled. Raises ImageError if the image cannot be
    encoded, CollectingError and OSError like `CollectedFolder.ids_of`.
    """
    size_hw, names = candidate.image.size_hw, candidate.rules.class_names
    detections = _visible(candidate.detections, candidate.rules.blank_regions, size_hw)
    record = CollectedFrame(
        image=folder.new_path(candidate.rules.camera),
        camera=candidate.rules.camera,
        frame_id=candidate.origin.frame_id,
        sec=candidate.origin.sec,
        nanosec=candidate.origin.nanosec,
        size_wh=size_hw[::-1],
        weights_sha256=candidate.rules.weights_sha256,
        configuration=candidate.rules.configuration,
        reasons={reason.value: why.words for reason, why in reasons.items()},
        value=value_of(reasons),
        objects=tuple(
            CollectedObject(
                class_name=found.class_name,
                score=found.score,
                box_xyxy=found.box_xyxy,
                track_id=found.track_id,
            )
            for found in detections.objects(names)
        ),
        embedding=embedding_text(candidate.embedding),
        shades=shades_text(candidate.shades),
    )
    labels = label_text(detections, size_hw, folder.ids_of(names), as_polygons=candidate.rules.segments)
    return record, _jpeg(candidate), labels


def _jpeg(candidate: Candidate) -> bytes:
    """The image as it was received if that was a JPEG file, unless regions of it are blanked out."""
    regions = candidate.rules.blank_regions
    if candidate.jpeg is not None and not regions:
        return candidate.jpeg.tobytes()
    return encode_jpeg(candidate.visible_image, quality=candidate.rules.jpeg_quality).tobytes()


def _visible(detections: Detections, regions: tuple[Region, ...], size_hw: tuple[int, int]) -> Detections:
    """Those whose centre is in none of the `regions`."""
    boxes = detections.boxes_xyxy.astype(np.float64)
    centres_xy = (boxes[:, :2] + boxes[:, 2:]) / 2 / (size_hw[1], size_hw[0])
    hidden: NDArray[np.bool_] = np.zeros(len(detections), np.bool_)
    for region in regions:
        hidden |= region.contains(centres_xy)
    return detections[~hidden] if regions else detections
