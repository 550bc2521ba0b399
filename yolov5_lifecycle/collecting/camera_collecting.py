"""Frames of one camera, looked at after they were detected: which may be worth keeping."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.collecting.candidate import Candidate, Origin
from yolov5_lifecycle.collecting.collector import Collector
from yolov5_lifecycle.collecting.object_memory import Change, ObjectMemory
from yolov5_lifecycle.collecting.pace import Pace
from yolov5_lifecycle.collecting.reason import Reason, Why
from yolov5_lifecycle.collecting.rules import CollectRules
from yolov5_lifecycle.collecting.usual_look import UsualLook
from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.detection.nms import Selection
from yolov5_lifecycle.images.image import ColourImage

LOOK_PERIOD_S = 0.2
"""Frames are looked at no more often; what happens to objects is noticed in every frame."""
_MOST_UNUSUAL = 8
"""Times the usual distance: nothing is worth more."""
MAX_CHANGES = 10
"""Changes between two looks that are written down."""


class _Past:
    """What the next frame of a camera is compared with. Used by one inference thread at a time."""

    def __init__(self) -> None:
        self.memory = ObjectMemory()
        self.usual = UsualLook()
        self.pace = Pace()
        self.looked_s = -math.inf
        self.frames = 0
        self.is_sample = False
        self.changes: list[Change] = []
        self.is_requested = False
        """Set in any thread."""


@dataclass(frozen=True)
class CameraCollecting:
    """Offers frames of one camera to `collector`; `with_rules` of others keeps what is known of the past.

    Used by one inference thread at a time. `clock` returns monotonic seconds.
    """

    collector: Collector
    rules: CollectRules
    clock: Callable[[], float] = time.monotonic
    past: _Past = field(default_factory=_Past)

    def with_rules(self, rules: CollectRules) -> CameraCollecting:
        """The same with other rules, for later frames: the one in progress has those that it began with."""
        return replace(self, rules=rules)

    def request(self) -> None:
        """Keep the next frame. May be called in any thread."""
        self.past.is_requested = True

    def wanted(self, selection: Selection) -> Selection:
        """What to find in the next frame, besides `selection`: more if the frame will be looked at."""
        is_due = self.clock() - self.past.looked_s >= LOOK_PERIOD_S and self._may_keep()
        return self.rules.extended(selection) if is_due or self.past.is_requested else selection

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
        rules, past = self.rules, self.past
        changes = past.memory.changes(published, image.size_hw, rules.class_names)
        past.changes = [*past.changes, *filter(rules.wants, changes)][-MAX_CHANGES:]
        past.frames += 1
        past.is_sample |= bool(rules.every) and past.frames % rules.every == 0
        if found.embedding is None:
            if not self._may_keep():
                past.changes.clear()
            return
        reasons = dict(self._reasons(found, found.embedding))
        past.looked_s, past.is_sample, past.is_requested = self.clock(), False, False
        past.changes.clear()
        if reasons or rules.novelty:
            self.collector.offer(
                Candidate(
                    image=image,
                    jpeg=jpeg,
                    detections=published,
                    embedding=found.embedding,
                    origin=origin,
                    reasons=reasons,
                    rules=rules,
                    pace=past.pace,
                )
            )

    def _may_keep(self) -> bool:
        """Whether the gap after the last kept frame is over."""
        rules = self.rules
        return self.past.pace.allows(self.clock(), gap_s=rules.gap_s, per_minute=rules.per_minute)

    def _reasons(self, found: Detections, embedding: NDArray[np.float32]) -> Iterator[tuple[Reason, Why]]:
        """Each reason once, with everything that is behind it."""
        if self.past.is_requested:
            yield Reason.REQUESTED, Why("~/collect")
        if self.past.is_sample:
            yield Reason.SAMPLE, Why(f"one of {self.rules.every}")
        yield from self.rules.reasons(found)
        times = self.past.usual.times_usual(embedding, self.rules.weights_sha256)
        if self.rules.unusual and times >= self.rules.unusual:
            yield Reason.UNUSUAL, Why(f"{times:.1f} times as far as usual", min(times / _MOST_UNUSUAL, 1))
        for reason in (Reason.UNSTEADY, Reason.APPEARED):
            if texts := [text for changed, text in self.past.changes if changed is reason]:
                yield reason, Why(", ".join(texts))
