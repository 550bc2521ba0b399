"""Frames of cameras, looked at after they were detected, and the thread that decides which are kept."""

from __future__ import annotations

import logging
import math
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.collecting.candidate import (
    PACE_MIN,
    Candidate,
    CollectRules,
    Detail,
    Origin,
    Pace,
    Trigger,
)
from yolov5_lifecycle.collecting.collected_files import CollectingError, KeptImage
from yolov5_lifecycle.collecting.collected_folder import CollectedFolder
from yolov5_lifecycle.collecting.descriptors import Embedding, UsualDescriptor
from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.detection.nms import Selection
from yolov5_lifecycle.images.image import ColourImage, ImageError
from yolov5_lifecycle.printable import in_one_line

MAX_WAITING = 8
"""Candidates that wait for the disk; more are dropped and counted."""
MAX_WAITING_BYTES = 256 << 20
"""Of their images together; one alone may be larger."""
IDLE_S = 30.0
"""Without a candidate for that long, the folder is closed: its disk can be unmounted."""
RETRY_S = 10.0
"""After a failure candidates are dropped for that long."""
NOVEL_DISTANCE = 0.1
"""An image is novel whose cosine distance to all that are kept is no less."""
LOOK_PERIOD_S = 0.2
"""Frames are looked at no more often."""
TIMES_UNUSUAL = 3.0
"""An image is unusual that is so many times as far from the usual ones as they are."""
_MOST_UNUSUAL = 8
"""Times the usual distance: nothing is worth more."""

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class CollectorStatus:
    """What became of the candidates since the process started, for diagnostics."""

    kept: int = 0
    duplicates: int = 0
    """Near duplicates of kept images."""
    outranked: int = 0
    """Less valuable than all that a full folder has."""
    dropped: int = 0
    """Lost because the disk is too slow, or fails."""
    frames: int = 0
    """In the folder."""
    megabytes: float = 0.0
    problem: str = ""
    """Why nothing can be kept now; "" if that is not known to be so."""


class Collector:
    """Owns the folder that `open_folder` opens, and the thread that writes into it, until `close`.

    The thread starts with the first candidate. `clock` returns monotonic seconds.
    """

    def __init__(
        self, open_folder: Callable[[], CollectedFolder], *, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._open_folder = open_folder
        self._clock = clock
        self._waiting: deque[Candidate] = deque()
        self._changed = threading.Condition()
        self._is_closing = False
        self._thread: threading.Thread | None = None
        self._folder: CollectedFolder | None = None
        self._failed_s: float | None = None
        self._is_shut = False
        """Whether the last failure was that the folder could not be opened."""
        self.status = CollectorStatus()
        """Replaced as a whole; may be read in any thread."""

    def offer(self, candidate: Candidate) -> None:
        """Take a candidate, or count it as dropped if too many wait; never waits for the disk."""
        with self._changed:
            held = sum(waiting.held_bytes for waiting in self._waiting)
            is_full = len(self._waiting) >= MAX_WAITING or held + candidate.held_bytes > MAX_WAITING_BYTES
            if self._is_closing or (self._waiting and is_full):
                self._count("dropped")
                return
            self._waiting.append(candidate)
            self._changed.notify()
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, name="collector", daemon=True)
                self._thread.start()

    def close(self, timeout_s: float) -> bool:
        """Keep what waits, end the thread and close the folder; False if it hangs. Idempotent."""
        with self._changed:
            self._is_closing = True
            self._changed.notify()
        if self._thread is None:
            self._close_folder()
            return True
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting or self._is_closing, IDLE_S)
                candidate = self._waiting.popleft() if self._waiting else None
                is_over = self._is_closing and candidate is None
            if candidate is None:
                self._close_folder()
            else:
                self.decide(candidate)
            if is_over:
                return

    def decide(self, candidate: Candidate) -> None:
        """Keep the candidate or not; a failure is logged once, and tried again after RETRY_S."""
        now_s = self._clock()
        if self._failed_s is not None and now_s - self._failed_s < RETRY_S:
            self._count("dropped")
            return
        if not (candidate.is_requested or candidate.pace.allows(now_s)):
            return
        try:
            if self._folder is None:
                self._folder = self._open_folder()
                if self._is_shut:
                    self._note(problem="")  # it is over, whether this candidate is kept or not
            self._keep(candidate, self._folder, now_s)
        except (CollectingError, ImageError, OSError) as error:
            self._fail(str(error), now_s)
        except Exception as error:  # noqa: BLE001 - without this thread no image would be kept any more
            _log.exception("unexpected %s while an image was collected", type(error).__name__)
            self._fail(f"unexpected {type(error).__name__}: {error}", now_s)

    def _keep(self, candidate: Candidate, folder: CollectedFolder, now_s: float) -> None:
        rules, embedding = candidate.rules, candidate.embedding
        if not candidate.is_requested and folder.descriptors.is_duplicate(embedding, candidate.shades):
            self._count("duplicates")
            return
        reasons = dict(candidate.reasons)
        distance = folder.descriptors.distance(embedding)
        if Trigger.NOVEL in rules.triggers and len(embedding) and distance >= NOVEL_DISTANCE:
            words = f"distance {distance:.2f} from the nearest image"
            reasons[Trigger.NOVEL] = Detail(words if math.isfinite(distance) else "the first of its kind")
        if not reasons:
            return
        labels = candidate.labels(folder.ids_of(rules.class_names))
        record = candidate.record(folder.session.new_path(rules.camera), reasons)
        rival = None if candidate.is_requested else _rival(candidate, folder, now_s)
        if (rival is None or rival.value < record.value) and folder.add(record, candidate.jpeg(), labels):
            if rival is not None and folder.kept([rival.path]):  # a full folder may have removed it
                folder.remove(rival.path)
            candidate.pace.keep(record.image, now_s)
            self._count("kept")
        else:
            self._count("outranked")
        self._failed_s = None
        self._note(frames=len(folder), megabytes=folder.size_bytes / 1e6, problem="")

    def _fail(self, problem: str, now_s: float) -> None:
        problem = in_one_line(problem)
        if problem != self.status.problem:
            _log.warning("no images are collected: %s", problem)
        self._failed_s, self._is_shut = now_s, self._folder is None
        self._count("dropped")
        self._note(problem=problem)
        self._close_folder()

    def _close_folder(self) -> None:
        folder, self._folder = self._folder, None
        if folder is not None:
            folder.close()

    def _count(self, what: str) -> None:
        with self._changed:
            self._note(**{what: getattr(self.status, what) + 1})

    def _note(self, **values: Any) -> None:
        with self._changed:
            self.status = replace(self.status, **values)


def _rival(candidate: Candidate, folder: CollectedFolder, now_s: float) -> KeptImage | None:
    """The least valuable image of the last minutes, if one has to go when `candidate` is kept."""
    per_minute = candidate.rules.settings.collect_per_minute
    if not (count := math.ceil(per_minute * PACE_MIN)):
        return None
    recent = folder.kept(candidate.pace.since(now_s - 60 * count / per_minute))
    return min(recent, key=lambda kept: kept.value) if len(recent) >= count else None


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
