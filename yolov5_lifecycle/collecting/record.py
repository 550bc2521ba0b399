"""A line of `frames.jsonl`: what is known about a kept image."""

from __future__ import annotations

import base64
import re
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from yolov5_lifecycle.collecting.descriptors import SHADES, Embedding, Shades, unit
from yolov5_lifecycle.printable import in_one_line

MAX_RECORD_BYTES = 32 << 20
"""Of a line; one of 30,000 objects with the longest names has 30 MB, one of 1,000 usual ones 150 kB."""
_MAX_VALUES = 300_000
"""Of a line, and lists and objects in it: one of 30,000 objects has 240,000. Each takes up to 300 bytes."""
MAX_EMBEDDING = 8192
_IMAGE = re.compile(r"images/[0-9A-Za-z-]{1,64}/[0-9]{6,9}(_[0-9A-Za-z_]{1,64})?\.jpg")


class CollectingError(ValueError):
    """Nothing can be kept now, or read; the message has the cause and a remedy."""


class RecordError(CollectingError):
    """A line that is no record; the message says why."""


class _Strict(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)


class CollectedObject(_Strict):
    """A predicted object, before anybody corrected it."""

    class_name: str = Field(max_length=1000)
    score: float = Field(ge=0, le=1)
    box_xyxy: tuple[float, float, float, float]
    """In pixels."""
    track_id: str = Field(max_length=100)


class CollectedFrame(_Strict):
    """A kept image: where it comes from, why it was kept, and what a model saw in it."""

    image: str = Field(max_length=200, pattern=f"^{_IMAGE.pattern}$")
    """Path below the folder."""
    camera: str = Field(max_length=100)
    frame_id: str = Field(max_length=1000)
    sec: int
    nanosec: int
    size_wh: tuple[int, int]
    weights_sha256: str = Field(max_length=64)
    configuration: str = Field(max_length=64)
    """Digest of the settings, as in diagnostics."""
    reasons: dict[str, str] = Field(max_length=20)
    """Details in words by the value of `Trigger`; other versions have other triggers."""
    value: float
    """Of a full folder the frames with the lowest value go first."""
    objects: tuple[CollectedObject, ...] = Field(max_length=30_000)
    embedding: str = Field(max_length=3 * MAX_EMBEDDING)
    """See `embedding_text`."""
    shades: str = Field(max_length=2 * SHADES)
    """Base64."""

    @classmethod
    def of_line(cls, line: bytes) -> CollectedFrame:
        """The record in `line`. Raises RecordError."""
        if len(line) > MAX_RECORD_BYTES or not line.endswith(b"\n"):
            raise RecordError(f"expected a whole line of at most {MAX_RECORD_BYTES} bytes, found {len(line)}")
        if max(line.count(b","), line.count(b"[") + line.count(b"{")) > _MAX_VALUES:
            raise RecordError(f"expected at most {_MAX_VALUES} values, lists and objects, found more")
        try:
            frame = cls.model_validate_json(line)
        except ValidationError as error:
            first = error.errors(include_url=False, include_input=False)[0]
            where = ".".join(map(str, first["loc"]))
            raise RecordError(in_one_line(f"{where}: {first['msg']}")) from None
        frame.descriptor()
        return frame

    def descriptor(self) -> tuple[Embedding, Shades]:
        """The embedding, of length 1 or (0,), and the shades. Raises RecordError."""
        embedding = _numbers("embedding", self.embedding, "<f2").astype(np.float32)
        shades = _numbers("shades", self.shades, "i1").astype(np.int8)
        if not np.isfinite(embedding).all() or len(shades) != SHADES:
            raise RecordError(f"expected an embedding of finite numbers and {SHADES} shades")
        return embedding, shades


@dataclass(frozen=True)
class FrameLine:
    """A line that is a record, and what many lines are chosen by: the record takes ten times the memory."""

    text: bytes
    image: str
    value: float
    size: int = 0
    """Bytes of the image, its labels and the line; 0 if unknown, or without an image."""

    @classmethod
    def of(cls, frame: CollectedFrame) -> FrameLine:
        return cls(frame.model_dump_json().encode() + b"\n", frame.image, frame.value)

    @property
    def frame(self) -> CollectedFrame:
        return CollectedFrame.of_line(self.text)

    @property
    def session(self) -> str:
        """The name of the subfolder: of the recording session of one process."""
        return self.image.split("/")[1]

    @property
    def labels(self) -> str:
        """Path of the labels below the folder."""
        return "labels" + self.image.removeprefix("images").removesuffix(".jpg") + ".txt"


def embedding_text(embedding: Embedding) -> str:
    """An embedding as float16, little-endian, of length 1, in base64; "" if it has no direction."""
    direction = unit(embedding)
    return "" if direction is None else base64.b64encode(direction.astype("<f2").tobytes()).decode()


def shades_text(shades: Shades) -> str:
    return base64.b64encode(shades.tobytes()).decode()


def _numbers(name: str, text: str, dtype: str) -> NDArray[Any]:
    try:
        return np.frombuffer(base64.b64decode(text, validate=True), dtype)
    except ValueError:
        raise RecordError(f"{name}: expected numbers of type {dtype} in base64") from None
