"""What a worker answers: one JSON object with one name, checked before anything in it is used."""

from __future__ import annotations

import json
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from yolov5_lifecycle.offline.many_recordings.recording_result import Count, RecordingResult, Text
from yolov5_lifecycle.printable import in_lines, in_one_line

MAX_BYTES = 32 << 20
"""Of an answer; a row with 10,000 class names of 200 letters has 24 MB at most."""

Word = Annotated[str, Field(pattern=r"^[a-z0-9]{1,20}$")]


class AnswerError(ValueError):
    """A worker answered something that it should not."""


class Answer(BaseModel):
    """Exactly one of these."""

    model_config = ConfigDict(frozen=True, strict=True, extra="forbid")

    ready: tuple[Word, Word] | None = None
    """Runtime and precision of the loaded model."""
    refused: Text | None = None
    """Why the model cannot be loaded, or no result can be written."""
    progress: Count | None = None
    """Images read of the recording."""
    ended: RecordingResult | None = None

    @model_validator(mode="after")
    def _is_one(self) -> Answer:
        if len(self.model_fields_set) != 1 or self.kind == "":
            raise ValueError("expected exactly one answer")
        return self

    @property
    def kind(self) -> str:
        """The name of the answer; "" if it has none."""
        return next((name for name in type(self).model_fields if getattr(self, name) is not None), "")


def read_answer(line: bytes | str, *, expected: frozenset[str], recording: str | None) -> Answer:
    """The answer in `line`; raises AnswerError unless it is one of the `expected` kinds.

    A row must be that of `recording`, which the worker was given.
    """
    try:
        answer = Answer.model_validate_json(line)
    except ValidationError as error:
        problem = error.errors(include_url=False, include_context=False, include_input=False)[0]["msg"]
        raise AnswerError(f"the worker answered something else: {in_one_line(problem)}") from None
    if answer.kind not in expected:
        raise AnswerError(f"the worker answered '{answer.kind}', which was not asked")
    if answer.ended is not None and answer.ended.recording != recording:
        raise AnswerError("the worker answered with the row of another recording")
    return answer


def refusal(error: Exception) -> dict[str, object]:
    """The answer of a worker that ends because of `error`."""
    return {"refused": in_lines(str(error) or type(error).__name__)}


def encoded(answer: dict[str, object]) -> str:
    """`answer` as a line of JSON, without the line break."""
    return json.dumps(answer)
