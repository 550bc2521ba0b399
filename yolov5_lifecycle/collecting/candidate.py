"""A frame that may be kept, and what is written of it: record, JPEG file and labels."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.collecting.collected_files import (
    CollectedFrame,
    CollectedObject,
    embedding_text,
    shades_text,
)
from yolov5_lifecycle.collecting.descriptors import Embedding, Shades, shades_of
from yolov5_lifecycle.collecting.triggers import CollectRules, Detail, Pace, Trigger, value_of
from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.images.compressed import encode_jpeg
from yolov5_lifecycle.images.image import ColourImage

_SUBPIXEL_BITS = 4
_JPEG_QUALITY = 90


@dataclass(frozen=True)
class Origin:
    """Where and when an image was taken: frame_id and stamp of its message."""

    frame_id: str
    sec: int
    nanosec: int


@dataclass(frozen=True, eq=False)
class Candidate:
    """A frame with what was found in it, on its way to the thread that decides and writes.

    The thread that offers it changes nothing in it afterwards.
    """

    image: ColourImage
    received_jpeg: NDArray[np.uint8] | None
    """(N,) the image as it was received, if that was a JPEG file."""
    detections: Detections
    """Those that are published, with masks if the model segments."""
    embedding: Embedding
    origin: Origin
    reasons: Mapping[Trigger, Detail]
    """Why it is worth keeping. May be empty: it may still be novel."""
    rules: CollectRules
    pace: Pace

    @property
    def is_requested(self) -> bool:
        return Trigger.REQUESTED in self.reasons

    @property
    def held_bytes(self) -> int:
        """Memory that it holds while it waits."""
        return self.image.pixels.nbytes + (0 if self.received_jpeg is None else self.received_jpeg.nbytes)

    @cached_property
    def shades(self) -> Shades:
        """Of what may be stored of the image."""
        return shades_of(self._visible_image)

    @cached_property
    def _visible_image(self) -> ColourImage:
        """The image with black regions where it must not be stored."""
        if not self.rules.blank_regions:
            return self.image
        pixels = np.ascontiguousarray(self.image.pixels).copy()
        height, width = self.image.size_hw
        for region in self.rules.blank_regions:
            corners = np.array(region.points_xy) * (width, height) * (1 << _SUBPIXEL_BITS)
            cv2.fillPoly(pixels, [np.rint(corners).astype(np.int32)], (0, 0, 0), shift=_SUBPIXEL_BITS)
        return ColourImage(pixels, self.image.order)

    @cached_property
    def _visible_detections(self) -> Detections:
        """Those whose centre is in no blank region."""
        height, width = self.image.size_hw
        boxes = self.detections.boxes_xyxy.astype(np.float64)
        centres_xy = (boxes[:, :2] + boxes[:, 2:]) / 2 / (width, height)
        hidden: NDArray[np.bool_] = np.zeros(len(boxes), np.bool_)
        for region in self.rules.blank_regions:
            hidden |= region.contains(centres_xy)
        return self.detections[~hidden]

    def jpeg(self) -> bytes:
        """The image as it was received if that was a JPEG file, unless regions of it are blanked out.

        Raises ImageError if it cannot be encoded.
        """
        if self.received_jpeg is not None and not self.rules.blank_regions:
            return self.received_jpeg.tobytes()
        return encode_jpeg(self._visible_image, quality=_JPEG_QUALITY).tobytes()

    def record(self, path: str, reasons: Mapping[Trigger, Detail]) -> CollectedFrame:
        """What is known about the image at `path`, which is kept for `reasons`."""
        rules = self.rules
        return CollectedFrame(
            image=path,
            camera=rules.camera,
            **vars(self.origin),
            size_wh=self.image.size_hw[::-1],
            weights_sha256=rules.weights_sha256,
            configuration=rules.settings.digest(),
            reasons={trigger.value: detail.words for trigger, detail in reasons.items()},
            value=value_of(reasons),
            objects=tuple(
                CollectedObject(**vars(found))
                for found in self._visible_detections.objects(rules.class_names)
            ),
            embedding=embedding_text(self.embedding),
            shades=shades_text(self.shades),
        )

    def labels(self, class_ids: Sequence[int]) -> str:
        """A line in YOLO format for each visible object; `class_ids[i]` is written for class i of the model.

        What is outside of the image is cut off; an object without area is left out. Of a model that segments
        each is the outline of its mask; the corners of its box where the mask is empty or missing.
        """
        found, lines = self._visible_detections, []
        height, width = self.image.size_hw
        boxes = np.clip(found.boxes_xyxy.astype(np.float64), 0, [width, height, width, height])
        for row, (x1, y1, x2, y2) in enumerate(boxes.tolist()):
            if x2 <= x1 or y2 <= y1:
                continue
            if self.rules.segments:
                values = _outline(found, row)
                if values is None:
                    values = np.array([[x1, y1], [x2, y1], [x2, y2], [x1, y2]])
            else:
                values = np.array([[(x1 + x2) / 2, (y1 + y2) / 2], [x2 - x1, y2 - y1]])
            fractions = np.clip(values / (width, height), 0, 1).ravel().tolist()
            shown = " ".join(f"{value:.6f}" for value in fractions)
            lines.append(f"{class_ids[found.class_ids[row]]} {shown}\n")
        return "".join(lines)


def _outline(found: Detections, row: int) -> NDArray[np.float64] | None:
    """The points (n, 2) around the largest part of a mask; None if it has no area."""
    if found.masks is None:
        return None
    window, inside = found.masks.inside_box(row, found.boxes_xyxy[row])
    parts = cv2.findContours(inside.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)[0]
    outline = max(parts, key=cv2.contourArea, default=None)
    if outline is None or len(outline) < 3 or not cv2.contourArea(outline):
        return None
    corner_xy = np.array([window.columns.start, window.rows.start])
    return np.asarray(outline.reshape(-1, 2) + corner_xy + 0.5, np.float64)
