"""Frames of one camera, looked at after they were detected: which may be worth keeping."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.collecting.candidate import Candidate, Origin
from yolov5_lifecycle.collecting.collector import Collector
from yolov5_lifecycle.collecting.object_memory import Change, ObjectMemory
from yolov5_lifecycle.collecting.pace import Pace
from yolov5_lifecycle.collecting.reason import Reason, Why
from yolov5_lifecycle.collecting.rules import CollectRules
from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.detection.nms import Selection
from yolov5_lifecycle.images.image import ColourImage

LOOK_PERIOD_S = 0.2
"""Frames are looked at no more often; what happens to objects is noticed in every frame."""
MAX_CHANGES = 10
"""Changes between two looks that are written down."""


class CameraCollecting:
    """Offers frames of one camera to `collector`. Used by one inference thread at a time.

    `rules` may be replaced between two frames. `clock` returns monotonic seconds.
    """

    def __init__(
        self,
        collector: Collector,
        rules: CollectRules,
        *,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._collector = collector
        self._clock = clock
        self._memory = ObjectMemory()
        self._pace = Pace()
        self._looked_s = -math.inf
        self._frames = 0
        self._is_sample = False
        self._changes: list[Change] = []
        self._is_requested = False
        self.rules = rules

    def request(self) -> None:
        """Keep the next frame. May be called in any thread."""
        self._is_requested = True

    def wanted(self, selection: Selection) -> Selection:
        """What to find in the next frame, besides `selection`: more if the frame will be looked at."""
        now_s, rules = self._clock(), self.rules
        is_due = now_s - self._looked_s >= LOOK_PERIOD_S and self._pace.allows(
            now_s, gap_s=rules.gap_s, per_minute=rules.per_minute
        )
        return rules.extended(selection) if is_due or self._is_requested else selection

    def look(
        self,
        found: Detections,
        published: Detections,
        image: ColourImage,
        jpeg: NDArray[np.uint8] | None,
        origin: Origin,
    ) -> None:
        """Offer a frame in which `found` was found with `wanted`, and `published` was published, if it may be
        worth keeping.

        `jpeg`: see `Candidate`.
        """
        rules, now_s = self.rules, self._clock()
        changes = self._memory.changes(published, image.size_hw, rules.class_names)
        self._changes = [*self._changes, *filter(rules.wants, changes)][-MAX_CHANGES:]
        self._frames += 1
        self._is_sample |= bool(rules.every) and self._frames % rules.every == 0
        if found.embedding is None:
            if not self._pace.allows(now_s, gap_s=rules.gap_s, per_minute=rules.per_minute):
                self._changes.clear()
            return
        reasons = dict(self._reasons(found))
        self._looked_s, self._is_sample, self._is_requested = now_s, False, False
        self._changes.clear()
        if reasons or rules.novelty:
            self._collector.offer(
                Candidate(
                    image=image,
                    jpeg=jpeg,
                    detections=published,
                    embedding=found.embedding,
                    origin=origin,
                    reasons=reasons,
                    rules=rules,
                    pace=self._pace,
                )
            )

    def _reasons(self, found: Detections) -> Iterator[tuple[Reason, Why]]:
        """Each reason once, with everything that is behind it."""
        if self._is_requested:
            yield Reason.REQUESTED, Why("~/collect")
        if self._is_sample:
            yield Reason.SAMPLE, Why(f"one of {self.rules.every}")
        yield from self.rules.reasons(found)
        for reason in (Reason.UNSTEADY, Reason.APPEARED):
            if texts := [text for changed, text in self._changes if changed is reason]:
                yield reason, Why(", ".join(texts), len(texts))
