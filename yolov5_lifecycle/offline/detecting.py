"""All pictures of a source, one after the other, and the account of them."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterable
from typing import Protocol, TypeVar

from yolov5_lifecycle.detections import Detections
from yolov5_lifecycle.detector import USUAL_SOURCE_HW
from yolov5_lifecycle.frame_balance import FrameBalance, FrameCounter, Outcome
from yolov5_lifecycle.images import ImageError, Picture
from yolov5_lifecycle.offline.stored_picture import StoredPicture
from yolov5_lifecycle.preparation import Prepare, prepare_model
from yolov5_lifecycle.runtimes.runtime import DeviceLostError, InferenceError
from yolov5_lifecycle.selection import model_problems, selection
from yolov5_lifecycle.settings import Settings, SettingsError

Stored = TypeVar("Stored", bound=StoredPicture)


class DetectingError(RuntimeError):
    """It makes no sense to go on, or nothing came of it."""


class Account:
    """What became of the pictures of a source that claims to have `expected`, 0 when it does not say."""

    def __init__(self, expected: int) -> None:
        self.expected = expected
        self.objects: Counter[str] = Counter()
        self._counter = FrameCounter()
        self._begun_s = time.monotonic()

    @property
    def balance(self) -> FrameBalance:
        return self._counter.balance()

    @property
    def rate_hz(self) -> float:
        """Pictures a second so far."""
        return self.balance.received / max(time.monotonic() - self._begun_s, 1e-9)

    def receive(self) -> None:
        self._counter.receive()

    def finish(self, outcome: Outcome) -> None:
        self._counter.finish(outcome)


class Watch(Protocol):
    """Who is told how it goes."""

    def lost(self, label: str, outcome: Outcome, error: Exception) -> None:
        """The picture called `label` gave no detections."""

    def progress(self, account: Account) -> None:
        """One more picture is done."""


class OfflineDetector:
    """Owns the model that `settings` name, made by `prepare`, and obeys their rules picture by picture.

    Raises ValueError or OSError like `prepare_model`, and SettingsError for a class that the model has not.
    """

    def __init__(self, settings: Settings, watch: Watch, *, prepare: Prepare = prepare_model) -> None:
        self.settings = settings
        self._watch = watch
        self._detector = prepare(settings, USUAL_SOURCE_HW).detector
        self.class_names = self._detector.class_names
        if problems := model_problems(settings, self.class_names):
            raise SettingsError(problems)
        self._selection = selection(settings, self.class_names)
        self._failures = 0

    def run(
        self,
        pictures: Iterable[Stored],
        *,
        expected: int,
        write: Callable[[Stored, Picture, Detections], None],
    ) -> Account:
        """Detect in every picture and `write` what was found; others are told, counted and left out.

        Raises DetectingError when inference failed too often in a row, when the device is lost, and when no
        picture at all could be used.
        """
        account = Account(expected)
        for stored in pictures:
            account.receive()
            account.finish(self._detect(stored, write, account.objects))
            self._watch.progress(account)
        if not account.balance[Outcome.DETECTED]:
            raise DetectingError(
                f"of {account.balance.received} pictures none could be used: see why above, or choose others"
            )
        return account

    def _detect(
        self,
        stored: Stored,
        write: Callable[[Stored, Picture, Detections], None],
        objects: Counter[str],
    ) -> Outcome:
        try:
            picture = stored.load()
            detections = self._detector.detect(picture, self._selection)
        except ImageError as error:
            self._watch.lost(stored.label, Outcome.REJECTED, error)
            return Outcome.REJECTED
        except InferenceError as error:
            self._watch.lost(stored.label, Outcome.FAILED, error)
            self._count_failure(error)
            return Outcome.FAILED
        self._failures = 0
        write(stored, picture, detections)
        objects.update(self.class_names[class_id] for class_id in detections.class_ids.tolist())
        return Outcome.DETECTED

    def _count_failure(self, error: InferenceError) -> None:
        self._failures += 1
        too_many = self._failures >= self.settings.max_consecutive_failures
        if too_many or isinstance(error, DeviceLostError):
            raise DetectingError(
                f"given up after {self._failures} failed pictures in a row: {error}"
            ) from error


LoadDetector = Callable[[], OfflineDetector]
"""Loads the model, once everything else is known to be right."""
