"""Label files in YOLO format: a line per object, a box or a polygon in fractions of the image."""

from __future__ import annotations

import io
import math
from pathlib import Path

from yolov5_lifecycle.evaluation.ground_truth import MAX_BOXES_PER_IMAGE, Boxes, DataError, Labels
from yolov5_lifecycle.input_file import RegularFileError, read_text_file

MAX_BYTES = 4 << 20
"""Of a label file; the largest of COCO, with polygons, has 60 kB."""
MAX_LINES = 2 * MAX_BOXES_PER_IMAGE
_TOLERANCE = 1e-4
"""How far outside of the image a fraction may be, as tools round."""
_MIN_POLYGON_FIELDS = 7


def label_text(path: Path) -> str | None:
    """The text of the label file at `path`, for `parsed_labels`; None if it does not exist.

    Raises DataError.
    """
    try:
        return read_text_file(path, MAX_BYTES).decode()
    except (FileNotFoundError, NotADirectoryError):
        return None
    except (OSError, RegularFileError) as error:
        raise DataError(error.strerror if isinstance(error, OSError) else str(error)) from None
    except UnicodeDecodeError:
        raise DataError("expected a text, found other bytes") from None


def parsed_labels(text: str, class_count: int) -> Labels:
    """The labels in `text`, with class ids below `class_count`; equal boxes count once.

    Raises DataError, with the line, if one is broken: an image with unknown objects cannot be evaluated.
    """
    objects = objects_in(text, class_count)
    boxes = dict.fromkeys((corners, class_id) for (class_id, _), corners in objects.items())
    return Labels(Boxes.of(*zip(*boxes, strict=True)) if boxes else Boxes.of([], []), in_fractions=True)


def objects_in(text: str, class_count: int) -> dict[tuple[int, tuple[float, ...]], tuple[float, ...]]:
    """Corners x1, y1, x2, y2 within the image by class id and numbers of a line, see `parsed_labels`."""
    objects: dict[tuple[int, tuple[float, ...]], tuple[float, ...]] = {}
    for number, line in enumerate(io.StringIO(text, newline=None), start=1):
        if number > MAX_LINES:
            raise DataError(f"more than {MAX_LINES} lines")
        if not line.strip():
            continue
        if len(objects) == MAX_BOXES_PER_IMAGE:
            raise DataError(f"more than {MAX_BOXES_PER_IMAGE} objects")
        try:
            class_id, values, corners = _object(line.split(), class_count)
            objects[class_id, values] = corners
        except DataError as error:
            raise DataError(f"line {number}: {error}") from None
    return objects


def _object(fields: list[str], class_count: int) -> tuple[int, tuple[float, ...], tuple[float, ...]]:
    """Class id, numbers and corners of one line."""
    if len(fields) != 5 and (len(fields) < _MIN_POLYGON_FIELDS or len(fields) % 2 == 0):
        raise DataError(
            "expected a class and 4 numbers (centre and size of a box) or at least 3 points of a polygon, "
            f"found {len(fields)} fields"
        )
    class_id, *values = map(_number, fields)
    if not class_id.is_integer() or not 0 <= class_id < class_count:
        raise DataError(f"expected a class from 0 to {class_count - 1}, found {fields[0][:20]}")
    outside = [value for value in values if not -_TOLERANCE <= value <= 1 + _TOLERANCE]
    if outside:
        raise DataError(f"expected fractions of the image from 0 to 1, found {outside[0]:g}")
    if len(values) == 4:
        cx, cy, width, height = values
        corners = (cx - width / 2, cy - height / 2, cx + width / 2, cy + height / 2)
    else:
        corners = (min(values[0::2]), min(values[1::2]), max(values[0::2]), max(values[1::2]))
    x1, y1, x2, y2 = (min(max(corner, 0.0), 1.0) for corner in corners)
    if not (x1 < x2 and y1 < y2):
        raise DataError("the object has no area")
    return int(class_id), tuple(values), (x1, y1, x2, y2)


def _number(field: str) -> float:
    try:
        value = float(field)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise DataError(f"expected numbers, found {field[:20]!r}")
    return value
