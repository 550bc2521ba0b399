"""The values of camera_info from a YAML file, as camera_calibration writes it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal
from urllib.parse import unquote

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator
from pydantic_core import PydanticCustomError

from yolov5_lifecycle.images.image import MAX_SIDE_PX
from yolov5_lifecycle.input_file import RegularFileError, read_regular_file, resolve_package
from yolov5_lifecycle.printable import in_one_line

MAX_FILE_BYTES = 64 * 1024
_COEFFICIENTS = {"plumb_bob": (4, 5), "rational_polynomial": (8, 12, 14), "equidistant": (4,)}
_MAX_SHOWN = 5
_FILE, _PACKAGE = "file://", "package://"

Side = Annotated[int, Field(ge=1, le=MAX_SIDE_PX)]


class Matrix(BaseModel):
    """A matrix in OpenCV's YAML format: rows, cols and row-major data."""

    model_config = ConfigDict(frozen=True, allow_inf_nan=False)

    rows: int = Field(ge=1, le=16)
    cols: int = Field(ge=1, le=16)
    data: Annotated[tuple[float, ...], Field(max_length=256)]

    @model_validator(mode="after")
    def _has_as_many_values_as_it_says(self) -> Matrix:
        if len(self.data) != self.rows * self.cols:
            raise PydanticCustomError(
                "matrix",
                "expected {rows} x {cols} values in data, found {found}",
                {"rows": self.rows, "cols": self.cols, "found": len(self.data)},
            )
        return self


class CameraInfoValues(BaseModel):
    """What a sensor_msgs/CameraInfo says of a camera and one image size, under the names in the file."""

    model_config = ConfigDict(frozen=True)

    image_width: Side
    image_height: Side
    camera_name: str = Field("", max_length=200)
    camera_matrix: Matrix
    distortion_model: Literal["plumb_bob", "rational_polynomial", "equidistant"]
    distortion_coefficients: Matrix
    rectification_matrix: Matrix
    projection_matrix: Matrix

    @model_validator(mode="after")
    def _has_the_right_shapes(self) -> CameraInfoValues:
        for name, shape in (
            ("camera_matrix", (3, 3)),
            ("rectification_matrix", (3, 3)),
            ("projection_matrix", (3, 4)),
        ):
            matrix: Matrix = getattr(self, name)
            if (matrix.rows, matrix.cols) != shape:
                raise _problem(
                    f"{name}: expected {shape[0]} x {shape[1]}, found {matrix.rows} x {matrix.cols}"
                )
        if min(self.camera_matrix.data[0], self.camera_matrix.data[4]) <= 0:
            raise _problem("camera_matrix: expected focal lengths above 0; has the camera been calibrated?")
        counts = _COEFFICIENTS[self.distortion_model]
        if len(self.distortion_coefficients.data) not in counts:
            raise _problem(
                f"distortion_coefficients: expected {' or '.join(map(str, counts))} for "
                f"{self.distortion_model}, found {len(self.distortion_coefficients.data)}"
            )
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
        try:
            return Path(resolve_package(url))
        except ValueError as error:
            raise ValueError(in_one_line(str(error))) from None
    path = Path(unquote(url.removeprefix(_FILE)))
    if not (url.startswith(_FILE) and path.is_absolute()):
        raise ValueError(
            f"'{in_one_line(url)}': expected file:///PATH with an absolute path, or package://PACKAGE/PATH."
        )
    return path


def _problem(text: str) -> PydanticCustomError:
    return PydanticCustomError("camera_info", "{text}", {"text": text})


def _described(error: ValidationError) -> str:
    """The first problems, each with its location in the file."""
    problems = [
        ": ".join(filter(None, (".".join(map(str, details["loc"]))[:100], details["msg"][:300])))
        for details in error.errors(include_url=False, include_input=False)
    ]
    further = f"; and {len(problems) - _MAX_SHOWN} more" if len(problems) > _MAX_SHOWN else ""
    return "; ".join(problems[:_MAX_SHOWN]) + further
