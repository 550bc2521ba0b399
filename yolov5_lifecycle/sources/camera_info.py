"""The values of camera_info from a YAML file, as camera_calibration writes it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal
from urllib.parse import unquote

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from yolov5_lifecycle.images.image import MAX_SIDE_PX
from yolov5_lifecycle.input_file import RegularFileError, read_regular_file, resolve_package
from yolov5_lifecycle.printable import in_one_line
from yolov5_lifecycle.spatial.camera_model import COEFFICIENTS

MAX_FILE_BYTES = 64 * 1024
_NUMBERS = (("camera_matrix", (9,)), ("rectification_matrix", (9,)), ("projection_matrix", (12,)))
_FILE, _PACKAGE = "file://", "package://"

Side = Annotated[int, Field(ge=1, le=MAX_SIDE_PX)]


class Matrix(BaseModel):
    """A matrix in OpenCV's YAML format: its numbers, row by row."""

    model_config = ConfigDict(frozen=True, allow_inf_nan=False)

    data: tuple[float, ...]


class CameraInfoValues(BaseModel):
    """What a sensor_msgs/CameraInfo says of a camera and one image size, under the names in the file."""

    model_config = ConfigDict(frozen=True)

    image_width: Side
    image_height: Side
    camera_matrix: Matrix
    distortion_model: Literal["plumb_bob", "rational_polynomial", "equidistant"]
    distortion_coefficients: Matrix
    rectification_matrix: Matrix
    projection_matrix: Matrix

    @model_validator(mode="after")
    def _is_of_a_calibrated_camera(self) -> CameraInfoValues:
        problems = []
        for name, counts in (*_NUMBERS, ("distortion_coefficients", COEFFICIENTS[self.distortion_model])):
            if (found := len(getattr(self, name).data)) not in counts:
                problems.append(f"{name}: expected {' or '.join(map(str, counts))} numbers, found {found}")
        if min(self.camera_matrix.data[:5:4], default=0.0) <= 0:
            problems.append("camera_matrix: expected focal lengths above 0; has the camera been calibrated?")
        if problems:
            raise ValueError("; ".join(problems))
        return self

    @property
    def size_hw(self) -> tuple[int, int]:
        """Height and width in pixels of the images."""
        return self.image_height, self.image_width


def read_camera_info(url: str) -> CameraInfoValues:
    """Read the file at `file:///PATH` or `package://PACKAGE/PATH`; ValueError says what is wrong with it."""
    path = _path(url)
    try:
        tree = yaml.safe_load(read_regular_file(path, MAX_FILE_BYTES))
        if not isinstance(tree, dict):
            raise ValueError("found no names and values")
        return CameraInfoValues.model_validate(tree)
    except ValidationError as error:
        problem = _described(error)
    except RegularFileError as error:
        problem = str(error)
    except OSError as error:
        problem = error.strerror or type(error).__name__
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        problem = f"expected the YAML file that camera_calibration writes: {error}"
    raise ValueError(f"{in_one_line(str(path))}: {in_one_line(problem).removesuffix('.')}.")


def _path(url: str) -> Path:
    if url.startswith(_PACKAGE):
        return Path(resolve_package(url))
    path = Path(unquote(url.removeprefix(_FILE)))
    if not (url.startswith(_FILE) and path.is_absolute()):
        raise ValueError(
            f"'{in_one_line(url)}': expected file:///PATH with an absolute path, or package://PACKAGE/PATH."
        )
    return path


def _described(error: ValidationError) -> str:
    """Every problem, with its location in the file unless it concerns several values."""
    problems = []
    for details in error.errors(include_url=False, include_input=False):
        location = ".".join(map(str, details["loc"]))
        problems.append(f"{location}{': ' if location else ''}{details['msg'].removeprefix('Value error, ')}")
    return "; ".join(problems)
