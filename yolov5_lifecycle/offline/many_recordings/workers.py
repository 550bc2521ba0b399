"""What all workers have in common, whether they are processes of this machine or of a cluster."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from yolov5_lifecycle.offline.many_recordings.plan import Plan
from yolov5_lifecycle.offline.many_recordings.recording_result import RecordingResult
from yolov5_lifecycle.offline.recordings import SourceRecording


@dataclass(frozen=True)
class Ready:
    """The worker has loaded the model into `runtime`, in `precision`."""

    worker: int
    runtime: str
    precision: str


@dataclass(frozen=True)
class Refused:
    """The worker has ended: the model cannot be loaded, or no result can be written."""

    worker: int
    reason: str


@dataclass(frozen=True)
class Progress:
    """The worker has read `images` images of its recording."""

    worker: int
    images: int


@dataclass(frozen=True)
class Ended:
    """The worker has finished its recording."""

    worker: int
    result: RecordingResult


@dataclass(frozen=True)
class Died:
    """The worker has ended unexpectedly."""

    worker: int
    reason: str


Event = Ready | Refused | Progress | Ended | Died


class Workers(Protocol):
    """Workers, each with one model, each with one recording at a time."""

    @property
    def max_count(self) -> int:
        """How many there should be at the same time."""

    def start(self, plan: Plan) -> int:
        """Start a worker and return its number."""

    def begin(self, worker: int, source: SourceRecording) -> None:
        """Give a recording to a worker that is ready."""

    def events(self, timeout_s: float) -> Sequence[Event]:
        """What has happened since the last call; waits up to `timeout_s` for something."""

    def close(self) -> None:
        """End all workers, together with what they are doing."""
