"""Frames of one camera, looked at after they were detected: which may be worth keeping."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.collecting.candidate import Candidate, Origin
from yolov5_lifecycle.collecting.collector import Collector
from yolov5_lifecycle.collecting.descriptors import Embedding, UsualDescriptor
from yolov5_lifecycle.collecting.triggers import CollectRules, Detail, Pace, Trigger
from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.detection.nms import Selection
from yolov5_lifecycle.images.image import ColourImage

LOOK_PERIOD_S = 0.2
"""Frames are looked at no more often."""
TIMES_UNUSUAL = 3.0
"""An image is unusual that is so many times as far from the usual ones as they are."""
_MOST_UNUSUAL = 8
"""Times the usual distance: nothing is worth more."""


class CameraCollecting:
    """Offers frames of one camera to `collector`.

    Used by one inference thread at a time; any thread may call `request`, and replace `rules` for later
    frames. `clock` returns monotonic seconds.
    """

    def __init__(
        self, collector: Collector, rules: CollectRules, *, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self.rules = rules
        self.pace = Pace()
        self._collector = collector
        self._clock = clock
        self._usual = UsualDescriptor()
        self._looked_s = -math.inf
        self._is_requested = False

    def request(self) -> None:
        """Keep the next frame."""
        self._is_requested = True

    def wanted(self, selection: Selection) -> Selection:
        """What to find in the next frame, besides `selection`: more if the frame will be looked at."""
        rules, now_s = self.rules, self._clock()
        is_due = now_s - self._looked_s >= LOOK_PERIOD_S and self.pace.allows(now_s)
        return rules.extended(selection) if is_due or self._is_requested else selection

    def look(
        self,
        found: Detections,
        published: Detections,
        image: ColourImage,
        received_jpeg: NDArray[np.uint8] | None,
        origin: Origin,
    ) -> None:
        """Offer a frame in which `found` was found with `wanted`, and `published` was published, if it may be
        worth keeping.

        `received_jpeg`: see `Candidate`.
        """
        rules = self.rules
        if found.embedding is None:
            return
        reasons = dict(self._reasons(rules, found, found.embedding))
        self._looked_s, self._is_requested = self._clock(), False
        if reasons or Trigger.NOVEL in rules.triggers:
            self._collector.offer(
                Candidate(
                    image=image,
                    received_jpeg=received_jpeg,
                    detections=published,
                    embedding=found.embedding,
                    origin=origin,
                    reasons=reasons,
                    rules=rules,
                    pace=self.pace,
                )
            )

    def _reasons(
        self, rules: CollectRules, found: Detections, embedding: Embedding
    ) -> Iterator[tuple[Trigger, Detail]]:
        """Each trigger once, with everything that is behind it."""
        if self._is_requested:
            yield Trigger.REQUESTED, Detail("~/collect")
        yield from rules.reasons(found)
        times = self._usual.times_usual(embedding, rules.weights_sha256)
        if Trigger.UNUSUAL in rules.triggers and times >= TIMES_UNUSUAL:
            yield Trigger.UNUSUAL, Detail(f"{times:.1f} times as far as usual", min(times / _MOST_UNUSUAL, 1))
