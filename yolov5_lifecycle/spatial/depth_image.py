"""Depth images, views of message buffers with the metres in them, and intrinsics of the depth camera."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.images.image import MAX_SIDE_PX, ImageError, check_frame_id, check_size, rows_of

MIN_DEPTH_M = 0.01
MAX_DEPTH_M = 1000.0
"""Beyond these a value is no measurement, but damage: no depth camera reaches either."""

MIN_FOCAL_PX = 0.1
MAX_PX = 1e7
"""Beyond these there is no camera, and coordinates in space would not be finite."""

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

    def metres_at(self, rows: NDArray[np.intp], columns: NDArray[np.intp]) -> NDArray[np.float32]:
        """Depth in metres at pixels, whose indices are broadcast against each other.

        NaN where there is no measurement: outside the image, 0, negative, NaN, infinite, or beyond
        MIN_DEPTH_M and MAX_DEPTH_M.
        """
        height, width = self.values.shape
        row, column = rows.clip(0, height - 1), columns.clip(0, width - 1)
        # Damaged floats may be signalling NaNs, of which numpy would warn.
        with np.errstate(invalid="ignore", over="ignore"):
            metres: NDArray[np.float32] = self.values[row, column].astype(np.float32)
            metres *= np.float32(self.metres_per_unit)
            is_measured = (metres >= MIN_DEPTH_M) & (metres <= MAX_DEPTH_M)
        is_measured &= (row == rows) & (column == columns)
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


@dataclass(frozen=True)
class Intrinsics:
    """A pinhole camera: focal lengths and principal point in pixels of an image of `size_hw`.

    The principal point counts from the centre of the first pixel, as in sensor_msgs/CameraInfo. Raises
    ImageError on construction unless focal lengths are in [0.1, 1e7], the principal point in
    [-1e7, 1e7] and the sides in [1, 16384].
    """

    fx: float
    fy: float
    cx: float
    cy: float
    size_hw: tuple[int, int]

    def __post_init__(self) -> None:
        are_focal_lengths = all(MIN_FOCAL_PX <= value <= MAX_PX for value in (self.fx, self.fy))
        if not (are_focal_lengths and all(abs(value) <= MAX_PX for value in (self.cx, self.cy))):
            raise ImageError(
                f"Expected intrinsics with fx and fy of {MIN_FOCAL_PX:g} to {MAX_PX:g} pixels and cx and cy "
                f"of at most {MAX_PX:g}, found fx {self.fx:g}, fy {self.fy:g}, cx {self.cx:g}, cy {self.cy:g}"
                ". Calibrate the camera, or have its driver publish the intrinsics of the depth image."
            )
        if not all(1 <= side <= MAX_SIDE_PX for side in self.size_hw):
            height, width = self.size_hw
            raise ImageError(
                f"Expected a camera_info with height and width of 1 to {MAX_SIDE_PX} pixels, found "
                f"{height} x {width}. Have the driver fill in the size of the depth image."
            )


def intrinsics_of_message(camera_info: Any) -> Intrinsics:
    """The intrinsics in a sensor_msgs/CameraInfo, deserialised by any library.

    P counts where it is filled in: depth images are rectified, and P is the camera of the rectified image.
    Otherwise K. Raises ImageError as `Intrinsics`, for matrices of another size, and for a
    frame_id longer than MAX_FRAME_ID.
    """
    check_frame_id(camera_info)
    k, p = camera_info.k, camera_info.p
    if len(k) != 9 or len(p) != 12:
        raise ImageError(
            f"Expected a camera_info with K of 9 and P of 12 values, found {len(k)} and {len(p)}."
        )
    fx, cx, fy, cy = (p[0], p[2], p[5], p[6]) if p[0] else (k[0], k[2], k[4], k[5])
    size_hw = camera_info.height, camera_info.width
    return Intrinsics(float(fx), float(fy), float(cx), float(cy), size_hw)
