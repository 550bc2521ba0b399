"""Camera intrinsics: how pixels correspond to directions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from yolov5_lifecycle.images.image import MAX_SIDE_PX, ImageError, check_frame_id

MIN_FOCAL_PX = 0.1
MAX_PX = 1e7
"""Beyond these there is no camera, and coordinates in space would not be finite."""


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


def intrinsics_of(k: Sequence[float], p: Sequence[float], size_hw: tuple[int, int]) -> Intrinsics:
    """The intrinsics in the matrices of sensor_msgs/CameraInfo, row by row: `k` (3, 3) and `p` (3, 4).

    `p` counts where it is filled in: depth images are rectified, and `p` is the camera of the rectified
    image. Otherwise `k`. Raises ImageError for matrices of another size, and as `Intrinsics`.
    """
    if len(k) != 9 or len(p) != 12:
        raise ImageError(
            f"Expected a camera_info with K of 9 and P of 12 values, found {len(k)} and {len(p)}."
        )
    fx, cx, fy, cy = (p[0], p[2], p[5], p[6]) if p[0] else (k[0], k[2], k[4], k[5])
    return Intrinsics(float(fx), float(fy), float(cx), float(cy), size_hw)


def intrinsics_of_message(camera_info: Any) -> Intrinsics:
    """The intrinsics in a sensor_msgs/CameraInfo, deserialised by any library.

    Raises ImageError as `intrinsics_of`, and for a frame_id longer than MAX_FRAME_ID.
    """
    check_frame_id(camera_info)
    return intrinsics_of(camera_info.k, camera_info.p, (camera_info.height, camera_info.width))
