"""A frame that may be kept: why, what that is worth, and what is written of it: record, JPEG, labels."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from functools import cached_property
from typing import NamedTuple

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
from yolov5_lifecycle.detection.class_filter import class_ids
from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.detection.nms import WORTH_TELLING, Selection
from yolov5_lifecycle.images.compressed import encode_jpeg
from yolov5_lifecycle.images.image import ColourImage
from yolov5_lifecycle.images.region import BoxFilter, Region
from yolov5_lifecycle.settings.settings import Settings
from yolov5_lifecycle.settings.value_rules import COLLECT_REASONS, classes_of_reasons

SCORE_MARGIN = 0.1
"""A score that is no farther from its threshold is uncertain."""
GAP_S = 0.5
"""Between two kept frames of a camera, at least. With 1 s `benchmark.collected_errors` finds a third less."""
PACE_MIN = 5
"""Minutes of which the best frames are kept."""
_SUBPIXEL_BITS = 4
_JPEG_QUALITY = 90


class Trigger(Enum):
    """The value is what users read in records and, but for the first, write in `collect_reasons`."""

    REQUESTED = "requested"
    """Somebody asked for it."""
    CLASS = "class"
    """It has an object of one of the classes that are asked for."""
    UNCERTAIN = "uncertain"
    """A score is close to its threshold."""
    UNUSUAL = "unusual"
    """The image looks unlike what its camera usually sees."""
    NOVEL = "novel"
    """The image looks unlike those that are kept."""


class Detail(NamedTuple):
    """What is behind a trigger."""

    words: str
    strength: float = 1.0
    """In [0, 1]."""


_VALUES = {
    Trigger.REQUESTED: 1000.0,
    Trigger.CLASS: 20.0,
    Trigger.UNCERTAIN: 10.0,
    Trigger.UNUSUAL: 10.0,
    Trigger.NOVEL: 3.0,
}


def value_of(reasons: Mapping[Trigger, Detail]) -> float:
    """What a frame is worth that is kept for at least one trigger: what the best one is worth."""
    return max(_VALUES[trigger] * detail.strength for trigger, detail in reasons.items())


@dataclass(frozen=True, kw_only=True)
class CollectRules:
    """What is kept of a camera, whose name is "" if it has none."""

    settings: Settings
    """Of the camera."""
    selection: Selection
    """With which the detections that are published were found."""
    camera: str
    class_names: tuple[str, ...]
    """Of the model, like the two below."""
    segments: bool
    weights_sha256: str

    @cached_property
    def triggers(self) -> frozenset[Trigger]:
        """Those of `collect_reasons` without a class."""
        return frozenset(map(Trigger, {*self.settings.collect_reasons} & {*COLLECT_REASONS}))

    @cached_property
    def classes(self) -> frozenset[int]:
        """Those of `collect_reasons`. Raises ValueError if one is not a class of the model."""
        named = classes_of_reasons(self.settings.collect_reasons)
        return class_ids(named, self.class_names) or frozenset()

    @cached_property
    def blank_regions(self) -> tuple[Region, ...]:
        return tuple(map(Region.parse, self.settings.collect_blank_regions))

    def extended(self, selection: Selection) -> Selection:
        """`selection` and what a look needs: uncertain scores below a threshold, embedding, masks.

        Scores below WORTH_TELLING are noise, and so many that NMS would delay the frame.
        """
        margin = SCORE_MARGIN if Trigger.UNCERTAIN in self.triggers else 0.0
        lowest = max(self.selection.min_score - margin, WORTH_TELLING)
        with_masks = selection.with_masks or self.segments
        return replace(selection.wider(lowest), with_masks=with_masks, with_embedding=True)

    def reasons(self, found: Detections) -> Iterator[tuple[Trigger, Detail]]:
        """Which objects make an image worth keeping in which `found` was found with `extended`."""
        if Trigger.UNCERTAIN in self.triggers and (uncertain := self._uncertain(found)):
            yield Trigger.UNCERTAIN, uncertain
        is_above = self.selection.above_thresholds(found.scores, found.class_ids)
        if listed := self.classes.intersection(found.class_ids[is_above].tolist()):
            yield Trigger.CLASS, Detail(", ".join(self.class_names[class_id] for class_id in sorted(listed)))

    def _uncertain(self, found: Detections) -> Detail | None:
        """The score within the margin that is closest to its threshold; all low scores count."""
        thresholds = self.selection.thresholds(found.class_ids)
        distances = np.abs(found.scores - thresholds)
        count = int(np.count_nonzero(distances <= SCORE_MARGIN))
        if not count:
            return None
        row = int(distances.argmin())
        name = self.class_names[int(found.class_ids[row])]
        closest = f"{name} {float(found.scores[row]):.2f}, threshold {float(thresholds[row]):g}"
        words = closest if count == 1 else f"{closest}, and {count - 1} more"
        return Detail(words, 1 - float(found.scores.mean()))


class Pace:
    """When frames of a camera were kept, in monotonic seconds.

    Asked by the inference thread, told by the thread that keeps frames.
    """

    def __init__(self) -> None:
        self._kept: deque[tuple[float, str]] = deque(maxlen=round(60 * PACE_MIN / GAP_S))

    def keep(self, image: str, now_s: float) -> None:
        """The frame at the path `image` is kept now."""
        self._kept.append((now_s, image))

    def allows(self, now_s: float) -> bool:
        """Whether a frame may be kept now: there is a gap between two."""
        return not self._kept or now_s - self._kept[-1][0] >= GAP_S

    def since(self, begin_s: float) -> list[str]:
        """The paths of frames that were kept later than `begin_s`."""
        return [image for kept_s, image in self._kept if kept_s > begin_s]


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
        return ColourImage(pixels, self.image.channel_order)

    @cached_property
    def _visible_detections(self) -> Detections:
        """Those whose centre is in no blank region."""
        visible = BoxFilter(ignore_regions=self.rules.blank_regions)
        return self.detections[visible.admits(self.detections.boxes_xyxy, self.image.size_hw)]

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
