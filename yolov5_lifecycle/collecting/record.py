"""A line of `frames.jsonl`: what is known about a kept image."""

from __future__ import annotations

import base64
import binascii
import re
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from yolov5_lifecycle.collecting.own_files import CollectingError
from yolov5_lifecycle.collecting.shades import SHADES, Shades
from yolov5_lifecycle.printable import in_one_line

MAX_RECORD_BYTES = 32 << 20
"""Of a line; one of 30,000 objects with the longest names has 30 MB, one of 1,000 usual ones 150 kB."""
_MAX_VALUES = 300_000
"""Of a line, and lists and objects in it: one of 30,000 objects has 240,000. Each takes up to 300 bytes."""
MAX_EMBEDDING = 8192
_IMAGE = re.compile(r"images/[0-9A-Za-z-]{1,64}/[0-9]{6,9}(_[0-9A-Za-z_]{1,64})?\.jpg")


class RecordError(CollectingError):
    """A line that is no record; the message says why."""


class _Placed:
    """The files that belong to the path `image` below the folder."""

    image: str

    @property
    def drive(self) -> str:
        """The name of the subfolder: of one process."""
        return self.image.split("/")[1]

    @property
    def labels(self) -> str:
        """Path of the labels below the folder."""
        return "labels" + self.image.removeprefix("images").removesuffix(".jpg") + ".txt"


class CollectedObject(BaseModel):
    """A predicted object, before anybody corrected it."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)

    class_name: str = Field(max_length=1000)
    score: float = Field(ge=0, le=1)
    box_xyxy: tuple[float, float, float, float]
    """In pixels."""
    track_id: str = Field(max_length=100)


class CollectedFrame(_Placed, BaseModel):
    """A kept image: where it comes from, why it was kept, and what a model saw in it."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)

    image: str = Field(max_length=200, pattern=f"^{_IMAGE.pattern}$")
    """Path below the folder; the labels are at the same path in `labels/`, with the suffix `.txt`."""
    camera: str = Field(max_length=100)
    frame_id: str = Field(max_length=1000)
    sec: int
    nanosec: int
    size_wh: tuple[int, int]
    weights_sha256: str = Field(max_length=64)
    configuration: str = Field(max_length=64)
    """Digest of the settings, as in diagnostics."""
    reasons: dict[str, str] = Field(max_length=20)
    """By the value of `Reason`, in words."""
    value: float
    """Of a full folder the frames with the lowest value go first."""
    objects: tuple[CollectedObject, ...] = Field(max_length=30_000)
    embedding: str = Field(max_length=3 * MAX_EMBEDDING)
    """See `embedding_text`."""
    shades: str = Field(max_length=2 * SHADES)
    """See `shades_text`."""

    def line(self) -> bytes:
        return self.model_dump_json().encode() + b"\n"

    @classmethod
    def of_line(cls, line: bytes) -> CollectedFrame:
        """The record in `line`. Raises RecordError."""
        if len(line) > MAX_RECORD_BYTES or not line.endswith(b"\n"):
            raise RecordError(f"expected a whole line of at most {MAX_RECORD_BYTES} bytes, found {len(line)}")
        if max(line.count(b","), line.count(b"[") + line.count(b"{")) > _MAX_VALUES:
            raise RecordError(f"expected at most {_MAX_VALUES} values, lists and objects, found more")
        try:
            frame = cls.model_validate_json(line)
            embedding_of(frame.embedding)
            shades_of_text(frame.shades)
        except ValidationError as error:
            first = error.errors(include_url=False, include_input=False)[0]
            where = ".".join(map(str, first["loc"]))
            raise RecordError(in_one_line(f"{where}: {first['msg']}")) from None
        return frame


@dataclass(frozen=True)
class FrameLine(_Placed):
    """A line that is a record, and what many lines are chosen by."""

    image: str
    value: float
    text: bytes
    size: int = 0
    """Bytes of the image, its labels and the line, if known."""

    @classmethod
    def of(cls, text: bytes) -> FrameLine:
        """The line `text`. Raises RecordError."""
        frame = CollectedFrame.of_line(text)
        return cls(frame.image, frame.value, text)

    @property
    def frame(self) -> CollectedFrame:
        return CollectedFrame.of_line(self.text)


def embedding_text(embedding: NDArray[np.float32]) -> str:
    """An embedding (C,) as text: of length 1, as float16, little-endian, in base64; "" if it is all zeros."""
    length = float(np.linalg.norm(embedding))
    if not np.isfinite(length) or length == 0:
        return ""
    return base64.b64encode((embedding / length).astype("<f2").tobytes()).decode()


def embedding_of(text: str) -> NDArray[np.float32]:
    """The embedding (C,) that `embedding_text` wrote, of length 1, or (0,). Raises RecordError."""
    stored = _numbers("embedding", text, "<f2").astype(np.float32)
    if not np.isfinite(stored).all():
        raise RecordError("embedding: expected finite numbers")
    return stored


def shades_text(shades: Shades) -> str:
    """Shades in base64."""
    return base64.b64encode(shades.tobytes()).decode()


def shades_of_text(text: str) -> Shades:
    """What `shades_text` wrote. Raises RecordError."""
    shades = _numbers("shades", text, "i1").astype(np.int8)
    if len(shades) != SHADES:
        raise RecordError(f"shades: expected {SHADES} numbers, found {len(shades)}")
    return shades


def _numbers(name: str, text: str, dtype: str) -> NDArray[Any]:
    try:
        return np.frombuffer(base64.b64decode(text, validate=True), dtype)
    except (binascii.Error, ValueError):
        raise RecordError(f"{name}: expected numbers of type {dtype} in base64") from None
