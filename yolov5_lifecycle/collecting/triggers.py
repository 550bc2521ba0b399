"""Triggers: why a frame is worth a label, what each is worth, and how often frames may be kept."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from enum import Enum
from functools import cached_property
from typing import NamedTuple

import numpy as np

from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.detection.nms import WORTH_TELLING, Selection
from yolov5_lifecycle.detection.selection import class_ids
from yolov5_lifecycle.images.region import Region
from yolov5_lifecycle.settings.settings import Settings
from yolov5_lifecycle.settings.value_rules import COLLECT_REASONS, classes_of_reasons

SCORE_MARGIN = 0.1
"""A score that is no farther from its threshold is uncertain."""
GAP_S = 0.5
"""Between two kept frames of a camera, at least. With 1 s `benchmark.collected_errors` finds a third less."""
PACE_MIN = 5
"""Minutes of which the best frames are kept."""


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
        is_admitted = self.selection.admits(found.scores, found.class_ids)
        if listed := self.classes.intersection(found.class_ids[is_admitted].tolist()):
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
        self._kept_s = -math.inf
        self._kept: deque[tuple[float, str]] = deque(maxlen=round(60 * PACE_MIN / GAP_S))

    def keep(self, image: str, now_s: float) -> None:
        """The frame at the path `image` is kept now."""
        self._kept_s = now_s
        self._kept.append((now_s, image))

    def allows(self, now_s: float) -> bool:
        """Whether a frame may be kept now: there is a gap between two."""
        return now_s - self._kept_s >= GAP_S

    def since(self, begin_s: float) -> list[str]:
        """The paths of frames that were kept later than `begin_s`."""
        return [image for kept_s, image in self._kept if kept_s > begin_s]
