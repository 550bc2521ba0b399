"""The result of one of many recordings."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator

from yolov5_lifecycle.models.class_names import MAX_NAME_LENGTH
from yolov5_lifecycle.models.model import MAX_CLASSES
from yolov5_lifecycle.printable import MAX_TEXT, is_utf8, printable

State = Literal["done", "skipped", "set aside"]

COUNTED = ("images", "detected", "rejected", "failed", "missing", "late", "jumps")
"""Columns of a row that are summed up for all recordings."""
_MAX_COUNT = 10**12
_MAX_PATH = 10_000
_MAX_SECONDS = 1e9


def _utf8(text: str) -> str:
    if not is_utf8(text):
        raise ValueError("expected text that can be encoded as UTF-8")
    return text


def _printable(text: str) -> str:
    if printable(text) != text:
        raise ValueError("expected printable characters, as in the class names of a model")
    return text


Count = Annotated[int, Field(ge=0, le=_MAX_COUNT)]
"""A sum over MAX_CLASSES classes still has 64 bits."""
Text = Annotated[str, Field(max_length=MAX_TEXT), AfterValidator(_utf8)]
ClassName = Annotated[str, Field(min_length=1, max_length=MAX_NAME_LENGTH), AfterValidator(_printable)]


class RecordingResult(BaseModel):
    """A row of the summary.

    Strict, because it is also read from files and received from workers; its texts may contain anything.
    """

    model_config = ConfigDict(frozen=True, strict=True, extra="forbid", allow_inf_nan=False)

    recording: Annotated[str, Field(min_length=1, max_length=_MAX_PATH), AfterValidator(_utf8)]
    """Its name, also the name of its result."""
    path: Annotated[str, Field(max_length=_MAX_PATH), AfterValidator(_utf8)]
    state: State
    """Skipped: it already had a result; the rest of the row is from the run that wrote it."""
    reason: Text = ""
    """Why it was set aside."""
    images: Count = 0
    detected: Count = 0
    rejected: Count = 0
    failed: Count = 0
    missing: Count = 0
    """Images that the recording claims and does not have."""
    late: Count = 0
    """Images that were not tracked, because a newer one had been."""
    jumps: Count = 0
    """Jumps back in time, at each of which tracking began anew."""
    first_problem: Text = ""
    """What was wrong with the first image that was rejected or failed."""
    seconds: Annotated[float, Field(ge=0, le=_MAX_SECONDS)] = 0.0
    runtime: Annotated[str, Field(max_length=40), AfterValidator(_utf8)] = ""
    detections: Annotated[dict[ClassName, Count], Field(max_length=MAX_CLASSES)] = {}
    """By class, for every class of the model; empty if the recording was set aside."""

    @model_validator(mode="after")
    def _adds_up(self) -> RecordingResult:
        if self.detected + self.rejected + self.failed > self.images:
            raise ValueError("expected no more images detected, rejected and failed than images")
        return self
