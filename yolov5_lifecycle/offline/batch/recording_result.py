"""The result of one recording of a batch."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict

State = Literal["done", "skipped", "set aside"]


class RecordingResult(BaseModel):
    """A row of the summary."""

    model_config = ConfigDict(frozen=True, strict=True)

    recording: str
    """Its name, also the name of its result."""
    path: str
    state: State
    """Skipped: it already had a result; the rest of the row is from the run that wrote it."""
    reason: str = ""
    """Why it was set aside."""
    images: int = 0
    detected: int = 0
    rejected: int = 0
    failed: int = 0
    first_problem: str = ""
    """What was wrong with the first image that was rejected or failed."""
    seconds: float = 0.0
    runtime: str = ""
    detections: dict[str, int] = {}
    """By class, for every class of the model; empty if the recording was set aside."""
