"""The thread that decides which candidates are kept, and writes them."""

from __future__ import annotations

import logging
import math
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace

from yolov5_lifecycle.collecting.candidate import Candidate
from yolov5_lifecycle.collecting.collected_folder import CollectedFolder
from yolov5_lifecycle.collecting.kept_frame import kept_frame
from yolov5_lifecycle.collecting.kept_looks import KeptLooks
from yolov5_lifecycle.collecting.own_files import CollectingError
from yolov5_lifecycle.collecting.reason import Reason, Why
from yolov5_lifecycle.images.image import ImageError
from yolov5_lifecycle.printable import in_one_line

MAX_WAITING = 8
"""Candidates that wait for the disk; more are dropped and counted."""
MAX_WAITING_BYTES = 256 << 20
"""Of their images together; one alone may be larger."""
IDLE_S = 30.0
"""Without a candidate for that long, the folder is closed: its disk can be unmounted."""
RETRY_S = 10.0
"""After a failure candidates are dropped for that long."""

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
        self.status = CollectorStatus()
        """Replaced as a whole; may be read in any thread."""

    def offer(self, candidate: Candidate) -> None:
        """Take a candidate, or count it as dropped if too many wait; never waits for the disk."""
        with self._changed:
            held = sum(waiting.held_bytes for waiting in self._waiting)
            is_full = len(self._waiting) >= MAX_WAITING or held + candidate.held_bytes > MAX_WAITING_BYTES
            if self._is_closing or (self._waiting and is_full):
                self.status = replace(self.status, dropped=self.status.dropped + 1)
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
        now_s, rules = self._clock(), candidate.rules
        if self._failed_s is not None and now_s - self._failed_s < RETRY_S:
            self._count(dropped=1)
            return
        if not candidate.is_requested and not candidate.pace.allows(
            now_s, gap_s=rules.gap_s, per_minute=rules.per_minute
        ):
            return
        try:
            self._keep(candidate, self._opened(), now_s)
        except (CollectingError, ImageError, OSError) as error:
            self._fail(str(error), now_s)
        except Exception as error:  # noqa: BLE001 - without this thread no image would be kept any more
            _log.exception("unexpected %s while an image was collected", type(error).__name__)
            self._fail(f"unexpected {type(error).__name__}: {error}", now_s)

    def _keep(self, candidate: Candidate, folder: CollectedFolder, now_s: float) -> None:
        rules, reasons = candidate.rules, dict(candidate.reasons)
        distance = folder.looks.distance(candidate.embedding)
        if distance < rules.duplicate_distance and _shows_nothing_new(candidate, folder.looks):
            self._count(duplicates=1)
            return
        if rules.novelty and len(candidate.embedding) and distance >= rules.novelty:
            reasons[Reason.NOVEL] = _novelty(distance)
        if not reasons:
            return
        record, jpeg, labels = kept_frame(candidate, reasons, folder)
        if folder.add(record, jpeg, labels):
            candidate.pace.kept(now_s, per_minute=rules.per_minute)
            self._count(kept=1)
        else:
            self._count(outranked=1)
        self._failed_s = None
        megabytes = folder.size_bytes / 1e6
        self.status = replace(self.status, frames=folder.frames, megabytes=megabytes, problem="")

    def _opened(self) -> CollectedFolder:
        if self._folder is None:
            self._folder = self._open_folder()
        return self._folder

    def _fail(self, problem: str, now_s: float) -> None:
        problem = in_one_line(problem)
        if problem != self.status.problem:
            _log.warning("no images are collected: %s", problem)
        self._failed_s = now_s
        self._count(dropped=1)
        self.status = replace(self.status, problem=problem)
        self._close_folder()

    def _close_folder(self) -> None:
        folder, self._folder = self._folder, None
        if folder is not None:
            folder.close()

    def _count(self, *, kept: int = 0, duplicates: int = 0, outranked: int = 0, dropped: int = 0) -> None:
        with self._changed:
            status = self.status
            self.status = replace(
                status,
                kept=status.kept + kept,
                duplicates=status.duplicates + duplicates,
                outranked=status.outranked + outranked,
                dropped=status.dropped + dropped,
            )


def _shows_nothing_new(candidate: Candidate, looks: KeptLooks) -> bool:
    """Whether a near image shows the same, and nobody asked for this one."""
    return not candidate.is_requested and looks.has_same_shades(
        candidate.embedding, candidate.shades, distance=candidate.rules.duplicate_distance
    )


def _novelty(distance: float) -> Why:
    if math.isinf(distance):
        return Why("the first of its kind")
    return Why(f"distance {distance:.2f} from the nearest image")
