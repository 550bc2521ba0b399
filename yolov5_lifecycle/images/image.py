"""Image type, size limits and byte buffers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

ChannelOrder = Literal["rgb", "bgr", "grey"]

MAX_SIDE_PX = 16384
"""Maximum width and height: no camera exceeds it, but a corrupt message may."""


MAX_FRAME_ID = 256
"""Characters. Each detection repeats the name, so a long one would multiply."""


class ImageError(ValueError):
    """A buffer without a usable image; the message states what was expected and found."""


@dataclass(frozen=True, eq=False)
class ColourImage:
    """Pixels with their channel order, so that no conversion pass is needed.

    Raises ImageError on construction unless `pixels` is a uint8 array (H, W, 3) with sides in [1, 16384].
    """

    pixels: NDArray[np.uint8]
    """(H, W, 3), possibly a read-only view with padded rows."""
    channel_order: ChannelOrder

    def __post_init__(self) -> None:
        _check_pixels(self.pixels)

    @property
    def size_hw(self) -> tuple[int, int]:
        """Height and width in pixels."""
        height, width, _ = self.pixels.shape
        return height, width

    @property
    def as_sent(self) -> tuple[NDArray[np.uint8], ChannelOrder]:
        """Pixels and their order before any conversion: (H, W, 3), or (H, W) if the order is grey."""
        return self.pixels, self.channel_order


def _check_pixels(pixels: object) -> None:
    if not isinstance(pixels, np.ndarray):  # such as None, which cv2.imread returns
        found = type(pixels).__name__
        raise ImageError(f"Pixels must be a uint8 array of shape (H, W, 3), found {found}.")
    if pixels.ndim != 3 or pixels.shape[2] != 3 or pixels.dtype != np.uint8:
        found = f"{pixels.dtype} of shape {pixels.shape}"
        raise ImageError(f"Pixels must be uint8 of shape (H, W, 3), found {found}.")
    check_size(pixels.shape[0], pixels.shape[1])


def check_size(height: int, width: int) -> None:
    """Raise ImageError unless both are in [1, 16384]."""
    if not (1 <= height <= MAX_SIDE_PX and 1 <= width <= MAX_SIDE_PX):
        raise ImageError(f"Height and width must be 1 to {MAX_SIDE_PX} pixels, found {height} x {width}.")


def bytes_of(data: Any) -> NDArray[np.uint8]:
    """A view (N,) of any contiguous buffer (bytes, array.array, memoryview, ndarray); else ImageError."""
    try:
        return np.frombuffer(data, np.uint8)
    except (TypeError, ValueError, BufferError):
        raise ImageError(f"Expected a contiguous buffer of bytes, found {type(data).__name__}.") from None


def rows_of(
    data: Any, *, rows: int, width: int, pixel_bytes: int, step: int, encoding: str
) -> NDArray[np.uint8]:
    """A read-only view (rows, width, pixel_bytes) of a buffer whose rows begin every `step` bytes.

    The last row may lack its padding. Raises ImageError when rows overlap or the buffer is too small.
    """
    buffer = bytes_of(data)
    what = f"rows of {width} {encoding} pixels"
    row_size = width * pixel_bytes
    if step < row_size:
        raise ImageError(f"The {what} need a step >= {row_size}, found {step}.")
    needed = step * (rows - 1) + row_size
    if buffer.size < needed:
        raise ImageError(f"{rows} {what} with step {step} need {needed} bytes, found {buffer.size}.")
    shape, strides = (rows, width, pixel_bytes), (step, pixel_bytes, 1)
    view: NDArray[np.uint8] = np.ndarray(shape, np.uint8, buffer, 0, strides)
    view.flags.writeable = False
    return view


def check_frame_id(message: Any) -> None:
    """Raise ImageError if the frame_id in the header of `message` has more than MAX_FRAME_ID characters."""
    length = len(message.header.frame_id)
    if length > MAX_FRAME_ID:
        raise ImageError(
            f"Expected a frame_id of at most {MAX_FRAME_ID} characters, found {length}. Correct it in the "
            "driver of the camera."
        )
