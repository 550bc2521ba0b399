"""JPEG segment parser that follows libjpeg, so that both see the same image.

Names and numbers of markers: ITU-T T.81, annex B.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.images.image import ImageError

MAX_SCANS = 100
"""Encoders write 1 scan, or about 10 for progressive files."""

MAX_SCANNED_PX = 1 << 28
"""Scans x pixels: the decoder visits every pixel for each scan, even an empty one."""

MAX_SEGMENTS = 1000
"""Segments plus fill bytes. libjpeg allocates 80 bytes for an APP1 segment of 4 bytes."""

_SOI, _EOI, _SOS = 0xD8, 0xD9, 0xDA
_FILL = 0xFF
_FRAMES = {0xC0, 0xC1, 0xC2}  # baseline, extended sequential, progressive: Huffman-coded
_OTHER_FRAMES = {*range(0xC0, 0xD0)} - _FRAMES - {0xC4, 0xC8, 0xCC}  # lossless, hierarchical, arithmetic
_TABLES_AND_TEXTS = {0xC4, 0xDB, 0xDD, *range(0xE0, 0xF0), 0xFE}  # DHT, DQT, DRI, APPn, COM
_DNL = 0xDC  # number of lines; libjpeg skips it
_COMPONENTS = {1, 3, 4}  # grey, YCbCr or RGB, CMYK or YCCK: the ones that OpenCV decodes

_WINDOW_BYTES = 1 << 16
# After 0xFF in coded data: 0 is an escaped data byte 0xFF, restart markers belong to the data.
_IS_MARKER = ~np.isin(np.arange(256), [0, *range(0xD0, 0xD8), _FILL])


def is_jpeg(buffer: NDArray[np.uint8]) -> bool:
    """Whether the bytes (N,) start with the JPEG signature."""
    return buffer[:3].tobytes() == b"\xff\xd8\xff"


def jpeg_shape_hwc(buffer: NDArray[np.uint8]) -> tuple[int, int, int]:
    """Height and width in pixels, and components, of the JPEG file (N,), parsed without decoding.

    Raises ImageError for files that OpenCV does not decode, for unusual structure such as markers without a
    length before the scans or a second frame header, and beyond MAX_SEGMENTS, MAX_SCANS or MAX_SCANNED_PX.
    """
    walk = _Walk(buffer)
    height, width, components = walk.shape_hwc()
    scans = walk.count_scans()
    if scans > MAX_SCANS or scans * height * width > MAX_SCANNED_PX:
        raise ImageError(
            f"A JPEG may have {MAX_SCANS} scans, and {MAX_SCANNED_PX} scans x pixels; "
            f"this one has {scans} of {height} x {width}. Save it as a baseline JPEG."
        )
    return height, width, components


class _Walk:
    """Parser state: position in the file and remaining segment budget."""

    def __init__(self, buffer: NDArray[np.uint8]) -> None:
        self._buffer = buffer
        self._data = buffer.data
        self._position = 2
        self._left = MAX_SEGMENTS

    def shape_hwc(self) -> tuple[int, int, int]:
        """As the only frame header has them; leaves the position after the first SOS marker."""
        shape_hwc = None
        while (marker := self._next_marker()) != _SOS:
            if marker in _FRAMES:
                if shape_hwc is not None:
                    raise ImageError("Expected a JPEG with one frame header, found a second one.")
                shape_hwc = self._frame_shape_hwc()
            elif marker not in _TABLES_AND_TEXTS:
                raise ImageError(f"Expected a baseline or progressive JPEG, found {_name(marker)}.")
            self._skip_segment(marker)
        if shape_hwc is None:
            raise ImageError("Expected a JPEG with a frame header, found a scan without one.")
        return shape_hwc

    def _next_marker(self) -> int:
        """Read the marker at the position and any fill bytes before it."""
        self._count_step()
        while self._byte(self._position) == _FILL and self._byte(self._position + 1) == _FILL:
            self._count_step()
            self._position += 1
        if self._byte(self._position) != _FILL:
            raise ImageError(f"Expected a JPEG marker at byte {self._position}, found another byte.")
        self._position += 2
        return self._byte(self._position - 1)

    def _count_step(self) -> None:
        self._left -= 1
        if self._left < 0:
            raise ImageError(f"A JPEG may have {MAX_SEGMENTS} segments and fill bytes, this one has more.")

    def count_scans(self) -> int:
        """Number of scans up to the end of the image; call after `shape_hwc`, which reads the first SOS."""
        scans, marker = 0, _SOS
        while marker != _EOI:
            if marker not in _TABLES_AND_TEXTS and marker not in (_SOS, _DNL):
                raise ImageError(f"Expected the scans of a JPEG, found {_name(marker)} among them.")
            scans += marker == _SOS
            self._skip_segment(marker)
            marker = self._marker_behind_data()
        return scans

    def _marker_behind_data(self) -> int:
        """The next marker after any coded data; EOI at the end of a file that lacks it."""
        self._count_step()
        while self._position + 1 < len(self._data):
            window = self._buffer[self._position : self._position + _WINDOW_BYTES]
            starts = np.flatnonzero(window[:-1] == 0xFF)
            markers = starts[_IS_MARKER[window[starts + 1]]]
            if markers.size:
                self._position += int(markers[0]) + 2
                return self._byte(self._position - 1)
            self._position += window.size - 1
        return _EOI

    def _skip_segment(self, marker: int) -> None:
        length = self._number(self._position)
        if length < 2 or self._position + length > len(self._data):
            raise ImageError(
                f"Expected a complete JPEG, found {len(self._data)} bytes in which {_name(marker)} "
                f"claims {length} bytes at {self._position}."
            )
        self._position += length

    def _frame_shape_hwc(self) -> tuple[int, int, int]:
        """From the frame header: length, bits, height, width, components, 3 bytes per component."""
        length, bits, components = (
            self._number(self._position),
            self._byte(self._position + 2),
            self._byte(self._position + 7),
        )
        if bits != 8:
            raise ImageError(f"Expected a JPEG of 8 bits, found {bits}.")
        if components not in _COMPONENTS or length != 8 + 3 * components:
            raise ImageError(
                f"Expected a JPEG of 1, 3 or 4 components, found {components} in a header of {length} bytes."
            )
        return self._number(self._position + 3), self._number(self._position + 5), components

    def _number(self, position: int) -> int:
        return self._byte(position) << 8 | self._byte(position + 1)

    def _byte(self, position: int) -> int:
        if position >= len(self._data):
            raise ImageError(
                f"Expected a complete JPEG, found {len(self._data)} bytes that end in its header."
            )
        return self._data[position]


def _name(marker: int) -> str:
    """Readable name and hex code of a marker, for messages."""
    if marker == _SOI:
        return "a second start of image (FFD8)"
    if marker == _EOI:
        return "the end of the image (FFD9)"
    if marker in _FRAMES | _OTHER_FRAMES:
        return f"a frame header of type SOF{marker - 0xC0} (FF{marker:02X})"
    return f"marker FF{marker:02X}"
