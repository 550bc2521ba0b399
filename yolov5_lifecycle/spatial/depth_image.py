"""Depth images, views of message buffers with the metres in them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.images.image import ImageError, check_frame_id, check_size, rows_of

MIN_DEPTH_M = 0.01
MAX_DEPTH_M = 1000.0
"""Beyond these a value is no measurement, but damage: no depth camera reaches either."""

_PROBES = 24

DEPTH_ENCODINGS: Mapping[str, tuple[str, float]] = MappingProxyType(
    {"16UC1": ("u2", 0.001), "32FC1": ("f4", 1.0)}
)
"""Encodings of depth images by name, as REP 118 defines them: type of a value, and metres per unit."""


@dataclass(frozen=True, eq=False)
class DepthImage:
    """Depth along the optical axis for each pixel, as the camera sent it."""

    values: NDArray[Any]
    """(H, W), of uint16 or float32, possibly a view with padded rows in either byte order.

    Not every value is a measurement.
    """
    metres_per_unit: float

    @property
    def size_hw(self) -> tuple[int, int]:
        """Height and width in pixels."""
        height, width = self.values.shape
        return height, width

    @property
    def is_blank(self) -> bool:
        """Whether there is no measurement at any of _PROBES x _PROBES pixels all over the image."""
        rows, columns = (np.linspace(0, side - 1, _PROBES).astype(np.intp) for side in self.size_hw)
        return bool(np.isnan(self.metres_at(rows[:, None], columns)).all())

    def metres_at(self, rows: NDArray[np.intp], columns: NDArray[np.intp]) -> NDArray[np.float32]:
        """Depth in metres at pixels, whose indices are broadcast against each other.

        NaN where there is no measurement: outside the image, 0, negative, NaN, infinite, or beyond
        MIN_DEPTH_M and MAX_DEPTH_M.
        """
        height, width = self.values.shape
        row, column = rows.clip(0, height - 1), columns.clip(0, width - 1)
        metres = self._metres(self.values[row, column])
        metres[~((row == rows) & (column == columns))] = np.nan
        return metres

    def metres_in(self, rows: range, columns: range) -> NDArray[np.float32]:
        """The same at all pixels (r, c) in these rows and columns of the image, faster."""
        places = (slice(each.start, each.stop, each.step) for each in (rows, columns))
        return self._metres(self.values[tuple(places)])

    def _metres(self, values: NDArray[Any]) -> NDArray[np.float32]:
        # Damaged floats may be signalling NaNs, of which numpy would warn.
        with np.errstate(invalid="ignore", over="ignore"):
            metres: NDArray[np.float32] = values.astype(np.float32)
            metres *= np.float32(self.metres_per_unit)
            is_measured = (metres >= MIN_DEPTH_M) & (metres <= MAX_DEPTH_M)
        metres[~is_measured] = np.nan
        return metres


def depth_image_of_message(image: Any) -> DepthImage:
    """The depth image in a sensor_msgs/Image, deserialised by any library: 16UC1 in mm or 32FC1 in m.

    Its `data` is any contiguous buffer (bytes, array.array, memoryview, ndarray), of which the result is a
    read-only view.

    Raises ImageError when the encoding is another or the buffer is too small for the layout, and for a
    frame_id longer than MAX_FRAME_ID.
    """
    check_frame_id(image)
    if image.encoding not in DEPTH_ENCODINGS:
        raise ImageError(
            f"Expected a depth image in {' or '.join(DEPTH_ENCODINGS)}, found encoding "
            f"{image.encoding[:40]!r}. Subscribe to the raw depth topic that is aligned to the colour image."
        )
    kind, metres_per_unit = DEPTH_ENCODINGS[image.encoding]
    check_size(image.height, image.width)
    dtype = np.dtype(kind).newbyteorder(">" if image.is_bigendian else "<")
    rows = rows_of(
        image.data,
        rows=image.height,
        width=image.width,
        pixel_bytes=dtype.itemsize,
        step=image.step,
        encoding=image.encoding,
    )
    return DepthImage(rows.view(dtype)[..., 0], metres_per_unit)
