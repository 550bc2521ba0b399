"""What makes a frame worth keeping, as the user set it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from yolov5_lifecycle.collecting.object_memory import Change
from yolov5_lifecycle.collecting.reason import Reason, Why
from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.detection.nms import WORTH_TELLING, Selection
from yolov5_lifecycle.detection.selection import class_ids
from yolov5_lifecycle.images.region import Region
from yolov5_lifecycle.settings.settings import Settings


@dataclass(frozen=True, kw_only=True)
class CollectRules:
    """The settings of a camera, those called `collect_...` by their rest, and its model."""

    camera: str
    """Its name, "" if it has none."""
    selection: Selection
    """With which the detections that are published were found."""
    class_names: tuple[str, ...]
    segments: bool
    weights_sha256: str
    classes: frozenset[int]
    score_margin: float
    filtered_score: float
    unsteady: bool
    appeared: bool
    unusual: float
    novelty: float
    duplicate_distance: float
    every: int
    gap_s: float
    per_minute: float
    jpeg_quality: int
    blank_regions: tuple[Region, ...]
    configuration: str
    """Identifies all settings, as in diagnostics."""

    @classmethod
    def of(
        cls,
        settings: Settings,
        selection: Selection,
        *,
        camera: str,
        class_names: tuple[str, ...],
        segments: bool,
        weights_sha256: str,
    ) -> CollectRules:
        """The rules in `settings` of a camera; the last three arguments are its model's.

        Raises ClassFilterError if a class is not one of the model.
        """
        return cls(
            camera=camera,
            selection=selection,
            class_names=class_names,
            segments=segments,
            weights_sha256=weights_sha256,
            classes=class_ids(settings.collect_classes, class_names) or frozenset(),
            score_margin=settings.collect_score_margin,
            filtered_score=settings.collect_filtered_score,
            unsteady=settings.collect_unsteady,
            appeared=settings.collect_appeared,
            unusual=settings.collect_unusual,
            novelty=settings.collect_novelty,
            duplicate_distance=settings.collect_duplicate_distance,
            every=settings.collect_every,
            gap_s=settings.collect_gap_s,
            per_minute=settings.collect_per_minute,
            jpeg_quality=settings.collect_jpeg_quality,
            blank_regions=tuple(map(Region.parse, settings.collect_blank_regions)),
            configuration=settings.digest(),
        )

    def extended(self, selection: Selection) -> Selection:
        """`selection` and what a look needs: scores within the margin below a threshold, embedding, masks.

        Scores below WORTH_TELLING are noise, and so many that NMS would delay the frame.
        """
        lowest = max(self.selection.min_score - self.score_margin, WORTH_TELLING)
        with_masks = selection.with_masks or self.segments
        return replace(selection.wider(lowest), with_masks=with_masks, with_embedding=True)

    def wants(self, change: Change) -> bool:
        """Whether a change of the objects is a reason to keep its image."""
        return self.unsteady if change[0] is Reason.UNSTEADY else self.appeared

    def reasons(self, found: Detections) -> Iterator[tuple[Reason, Why]]:
        """Why an image is worth keeping in which `found` was found with `extended`."""
        if self.score_margin and (uncertain := self._uncertain(found)):
            yield Reason.UNCERTAIN, uncertain
        if self.filtered_score and found.best_filtered >= self.filtered_score:
            yield Reason.FILTERED, Why(f"{found.best_filtered:.2f}, but it does not count")
        is_admitted = self.selection.admits(found.scores, found.class_ids)
        if listed := self.classes.intersection(found.class_ids[is_admitted].tolist()):
            yield Reason.CLASS, Why(", ".join(self.class_names[class_id] for class_id in sorted(listed)))

    def _uncertain(self, found: Detections) -> Why | None:
        """The score within the margin that is closest to its threshold; all low scores count."""
        distances = np.abs(found.scores - self.selection.thresholds(found.class_ids))
        count = int(np.count_nonzero(distances <= self.score_margin))
        if not count:
            return None
        row = int(distances.argmin())
        name, score = self.class_names[int(found.class_ids[row])], float(found.scores[row])
        closest = f"{name} {score:.2f}, threshold {float(self.selection.thresholds(found.class_ids)[row]):g}"
        words = closest if count == 1 else f"{closest}, and {count - 1} more"
        return Why(words, 1 - float(found.scores.mean()))
