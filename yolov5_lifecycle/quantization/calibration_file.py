"""The calibration file beside a weights file: what int8 needs to know of the activations of its network."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Literal

import torch
from pydantic import Field, ValidationError

from yolov5_lifecycle.atomic_file import atomic_write
from yolov5_lifecycle.checkpoints.locate import WeightsFile
from yolov5_lifecycle.input_file import RegularFileError, read_regular_file
from yolov5_lifecycle.models.network import Network
from yolov5_lifecycle.printable import in_one_line, shell_command
from yolov5_lifecycle.runtimes.quantization import (
    Quantization,
    QuantizationError,
    convolutions,
)

MAX_FILE_BYTES = 4 << 20
_MAX_TOLD = 200


class Calibration(Quantization):
    """The content of a calibration file."""

    format: Literal["yolov5_lifecycle calibration 3"] = "yolov5_lifecycle calibration 3"
    weights_sha256: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
    image_size: Annotated[int, Field(ge=32, le=4096)]


def path_beside(weights: Path) -> Path:
    """Path of the calibration for the file `weights`."""
    return weights.with_name(f"{weights.stem}.calibration.json")


def find_quantization(
    weights: WeightsFile, *, image_size: int, allowed: Callable[[Path], Path] | None = None
) -> Quantization:
    """That of the calibration beside `weights`, which must be for them and for `image_size`.

    Raises QuantizationError with the command that makes such a calibration, and what `allowed` raises for a
    path outside the folders of the user.
    """
    path = path_beside(weights.path)
    real = path if allowed is None else allowed(path)
    try:
        calibration = read_calibration(real)
        _check_made_for(calibration, weights, image_size)
    except QuantizationError as error:
        command = shell_command("calibrate", weights.path, "DATA", "--image-size", image_size)
        raise QuantizationError(
            f"{path}: {error}. Create one with `{command}`, where DATA is a folder of images, a video or a "
            "recording; or use precision 'fp32'."
        ) from None
    return calibration


def _check_made_for(calibration: Calibration, weights: WeightsFile, image_size: int) -> None:
    found, expected = calibration.weights_sha256, weights.sha256
    if found != expected:
        raise QuantizationError(
            f"the calibration was made for other weights (sha256 {found[:12]}..., not {expected[:12]}...)"
        )
    if calibration.image_size != image_size:
        raise QuantizationError(
            f"the calibration was made for image_size {calibration.image_size}, not {image_size}"
        )
    with torch.device("meta"):
        network = Network(weights.model.architecture)
    calibration.check(convolutions(network))


def read_calibration(path: Path) -> Calibration:
    """The calibration at `path`; at most MAX_FILE_BYTES are read.

    Raises QuantizationError, without the path and the remedy.
    """
    try:
        return Calibration.model_validate_json(read_regular_file(path, MAX_FILE_BYTES))
    except FileNotFoundError:
        raise QuantizationError("calibration not found") from None
    except OSError as error:
        problem = f"it cannot be read: {error.strerror}"
    except ValidationError as error:
        problem = _first_problem(error)
    except RegularFileError as error:
        problem = str(error)
    raise QuantizationError(f"this is not a usable calibration: {problem}")


def _first_problem(error: ValidationError) -> str:
    first = error.errors(include_url=False, include_context=False, include_input=False)[0]
    place = ".".join(map(str, first["loc"]))
    told = f"{place[:100]}: {first['msg']}" if place else first["msg"]
    return in_one_line(told)[:_MAX_TOLD].rstrip(".")


def write_calibration(path: Path, calibration: Calibration) -> None:
    """Write the file at `path`, whole or not at all. Raises OSError."""
    atomic_write(path, f"{calibration.model_dump_json()}\n".encode())


def calibration_digest(weights: Path) -> str | None:
    """SHA-256 of the calibration beside the file `weights`; None if there is none.

    A file that cannot be read counts as missing: `find_quantization` reports the problem.
    """
    try:
        return hashlib.sha256(read_regular_file(path_beside(weights), MAX_FILE_BYTES)).hexdigest()
    except (OSError, RegularFileError):
        return None
