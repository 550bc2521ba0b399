"""The calibration file beside a weights file: activation ranges for int8, and what was measured with them."""

from __future__ import annotations

import hashlib
import json
import logging
import os
import shlex
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Literal

import torch
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from yolov5_lifecycle.atomic_file import write_whole
from yolov5_lifecycle.checkpoints.locate import WeightsFile
from yolov5_lifecycle.input_file import RegularFileError, read_regular_file
from yolov5_lifecycle.models.model import Export
from yolov5_lifecycle.models.network import Network
from yolov5_lifecycle.printable import in_one_line
from yolov5_lifecycle.quantization.reference import Reference
from yolov5_lifecycle.runtimes.processor_abilities import abilities, weight_bits
from yolov5_lifecycle.runtimes.quantization import (
    Activation,
    Quantization,
    QuantizationError,
    convolutions,
)

SUFFIX = ".calibration.json"
MAX_FILE_BYTES = 4 << 20
MAX_TENSORS = 10_000
_MAX_TOLD = 200

_log = logging.getLogger(__name__)

Digest = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
Name = Annotated[str, Field(min_length=1, max_length=200)]
Figure = Annotated[float, Field(ge=-1e9, le=1e9)]
Share = Annotated[float, Field(ge=0, le=1)]
Range = tuple[Figure, Figure]
"""Lowest and highest value of an activation."""


class CalibrationError(ValueError):
    """A calibration that is missing, damaged or made for something else; the message has the remedy."""


class _Record(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)


class Measurement(_Record):
    """A runtime in one precision, measured on the calibration images and compared with fp32."""

    runtime: Literal["onnxruntime", "openvino"]
    precision: Literal["fp32", "int8", "bf16"]
    ms_per_image: Annotated[float, Field(gt=0, le=1e6)]
    processor_ms_per_image: Annotated[float, Field(gt=0, le=1e6)]
    """Of all processors together; another busy process affects this less."""
    agreement_f1: Share
    """F1 of its detections, those of fp32 taken as the truth; the same class, IoU of at least 0.5."""
    box_iou: Share
    """Mean IoU of the boxes that agree."""
    map_loss: Annotated[float, Field(ge=-100, le=100)] | None = None
    """Points of mAP@50:95 lost; None if there was no ground truth."""


class Calibration(_Record):
    """The content of a calibration file."""

    format: Literal["yolov5_lifecycle calibration 2"] = "yolov5_lifecycle calibration 2"
    """Version 1 had neither a digest nor a reference, so that nothing would show whether it is damaged."""
    weights_sha256: Digest
    data_sha256: Digest
    """Digest of the pixels of the calibration images."""
    images: Annotated[int, Field(ge=1, le=1_000_000)]
    image_size: Annotated[int, Field(ge=32, le=4096)]
    confidence_threshold: Share
    iou_threshold: Share
    weight_bits: Literal[7, 8]
    """Bits of the weights when it was measured; 7 on x86 without VNNI."""
    ranges: Annotated[dict[Name, Range], Field(min_length=1, max_length=MAX_TENSORS)]
    """Range of what each convolution reads, by its path in the network, as in the names of its weights."""
    means: Annotated[dict[Name, tuple[Figure, ...]], Field(max_length=MAX_TENSORS)]
    """Mean of each channel that the convolution reads."""
    fp32_layers: Annotated[tuple[Name, ...], Field(max_length=MAX_TENSORS)]
    """Paths of the convolutions that stay in fp32."""
    reference: Reference
    detections: Annotated[int, Field(ge=0, le=1_000_000_000)]
    """Detections of fp32 in the compared images; the fewer, the less is known."""
    measured: Annotated[tuple[Measurement, ...], Field(max_length=20)]
    computer_sha256: Digest
    """The computer on which it was measured, see `computer_digest`."""
    processor: Annotated[str, Field(max_length=200)]
    abilities: Annotated[tuple[Name, ...], Field(max_length=50)]
    versions: Annotated[dict[Name, Name], Field(max_length=20)]
    """Version by package name."""

    @field_validator("ranges")
    @classmethod
    def _are_ordered(cls, value: dict[str, Range]) -> dict[str, Range]:
        for name, (low, high) in value.items():
            if not (low <= 0 <= high and high - low >= 1e-6):
                raise ValueError(f"{name[:50]!r}: expected [low, high] with low <= 0 <= high and low < high")
        return value

    @model_validator(mode="after")
    def _fits_together(self) -> Calibration:
        if self.means.keys() != self.ranges.keys():
            raise ValueError("means: expected those of the same convolutions as the ranges")
        for name, (low, high) in self.ranges.items():
            width = high - low
            if not all(low - width <= mean <= high + width for mean in self.means[name]):
                raise ValueError(f"{name[:50]!r}: expected means near the range, {low:g} to {high:g}")
        measured = [(each.runtime, each.precision) for each in self.measured]
        if len(set(measured)) < len(measured):
            raise ValueError("measured: expected each runtime and precision once")
        return self

    @property
    def quantization(self) -> Quantization:
        """How the network is computed in int8 on this processor."""
        activations = {name: Activation(range_, self.means[name]) for name, range_ in self.ranges.items()}
        return Quantization(activations, frozenset(self.fp32_layers), weight_bits(abilities()))

    def measurement(self, runtime: str, precision: str) -> Measurement | None:
        """What was measured with `runtime` in `precision`."""
        wanted = (runtime, precision)
        return next((each for each in self.measured if (each.runtime, each.precision) == wanted), None)


class _Stored(Calibration):
    """What the file holds: the calibration, and the digest that shows damage."""

    content_sha256: Digest

    @property
    def calibration(self) -> Calibration:
        """Without the digest; raises ValueError if that is of other content."""
        calibration = Calibration.model_validate(self.model_dump(exclude={"content_sha256"}))
        if self.content_sha256 != content_sha256(calibration):
            raise ValueError("it is damaged or was edited: its content does not match its own digest")
        return calibration


def content_sha256(calibration: Calibration) -> str:
    """Digest of everything in `calibration`, which its file also holds."""
    return hashlib.sha256(_text(calibration.model_dump(mode="json")).encode()).hexdigest()


def path_beside(weights: Path) -> Path:
    """Path of the calibration for the file `weights`."""
    return weights.with_name(weights.stem + SUFFIX)


def remedy(weights: Path) -> str:
    """How to create a calibration for the file `weights`."""
    return (
        f"Create one with `calibrate {shlex.quote(str(weights))} DATA`, where DATA is a folder of images, a "
        "video or a recording; or use precision 'fp32'"
    )


def read_calibration(path: Path, *, weights: Path, weights_sha256: str) -> Calibration:
    """The calibration at `path` for the file `weights` with the digest `weights_sha256`.

    Raises CalibrationError; nothing in the file is executed, and at most MAX_FILE_BYTES are read.
    """
    try:
        stored = _Stored.model_validate_json(read_regular_file(path, MAX_FILE_BYTES))
        calibration = stored.calibration
    except FileNotFoundError:
        raise CalibrationError(f"{path}: calibration not found. {remedy(weights)}.") from None
    except OSError as error:
        problem = f"it cannot be read: {error.strerror}"
    except ValidationError as error:
        problem = _first_problem(error)
    except ValueError as error:  # not a regular file, too large, or another digest
        problem = str(error)
    else:
        if calibration.weights_sha256 != weights_sha256:
            raise CalibrationError(
                f"{path}: the calibration was made for other weights (sha256 "
                f"{calibration.weights_sha256[:12]}..., not {weights_sha256[:12]}...). {remedy(weights)}."
            )
        return calibration
    raise CalibrationError(f"{path}: this is not a usable calibration: {problem}. {remedy(weights)}.")


def find_calibration(
    weights: WeightsFile,
    *,
    precision: str,
    device: str,
    allowed: Callable[[Path], Path] | None = None,
) -> Calibration | str:
    """The calibration beside `weights`, or why none can be used.

    Precision int8 needs one: raises CalibrationError without it, and what `allowed` raises for a path outside
    the folders of the user. With auto, an unusable calibration is only logged; other precisions need none.
    """
    if isinstance(weights.content, Export):
        return "an export to ONNX is run as it is"
    if not _is_considered(precision, device):
        return "int8 was not requested"
    path = path_beside(weights.path)
    if precision == "auto" and not os.path.lexists(path):
        return f"int8 was not calibrated: there is no {path}"
    try:
        real = path if allowed is None else allowed(path)
        calibration = read_calibration(real, weights=weights.path, weights_sha256=weights.sha256)
        _check_network(calibration, path, weights)
    except ValueError as error:
        if precision == "int8":
            raise
        _log.warning("int8 is not considered: %s", error)
        return f"int8 is not considered: {error}"
    return calibration


def calibration_digest(weights: Path, *, precision: str, device: str) -> str | None:
    """SHA-256 of the calibration beside the file `weights`; None if it is missing or not needed.

    A file that cannot be read counts as missing: `find_calibration` reports the problem.
    """
    if not _is_considered(precision, device):
        return None
    try:
        return hashlib.sha256(read_regular_file(path_beside(weights), MAX_FILE_BYTES)).hexdigest()
    except (OSError, RegularFileError):
        return None


def _is_considered(precision: str, device: str) -> bool:
    return precision in ("int8", "auto") and device in ("auto", "cpu")


def _check_network(calibration: Calibration, path: Path, weights: WeightsFile) -> None:
    with torch.device("meta"):
        network = Network(weights.model.architecture)
    try:
        calibration.quantization.check(convolutions(network))
    except QuantizationError as error:
        raise CalibrationError(f"{path}: {error}. {remedy(weights.path)}.") from None


def write_calibration(path: Path, calibration: Calibration) -> None:
    """Write the file at `path`, whole or not at all. Raises OSError."""
    fields = calibration.model_dump(mode="json") | {"content_sha256": content_sha256(calibration)}
    write_whole(path, _text(fields).encode())


def _text(fields: Mapping[str, object]) -> str:
    """JSON with a line for each field, and for each entry of a field that has names."""
    lines = []
    for name, value in fields.items():
        text = json.dumps(value)
        if isinstance(value, dict):
            entries = (f"  {json.dumps(key)}: {json.dumps(entry)}" for key, entry in value.items())
            text = "{\n" + ",\n".join(entries) + "\n }"
        lines.append(f" {json.dumps(name)}: {text}")
    return "{\n" + ",\n".join(lines) + "\n}\n"


def _first_problem(error: ValidationError) -> str:
    first = error.errors(include_url=False, include_context=False, include_input=False)[0]
    place = ".".join(map(str, first["loc"]))
    told = f"{place[:100]}: {first['msg']}" if place else first["msg"]
    return in_one_line(told)[:_MAX_TOLD].rstrip(".")
