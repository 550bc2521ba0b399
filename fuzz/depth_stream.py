"""Fuzz target: messages of depth and colour cameras, in any order, with any stamps."""

from __future__ import annotations

import math
import struct
import weakref
from collections.abc import Iterator
from functools import partial
from types import SimpleNamespace

import numpy as np
from numpy.typing import NDArray

from fuzz.inputs import Fields, taken
from yolov5_lifecycle.images.image import ImageError
from yolov5_lifecycle.spatial.depth_image import (
    DEPTH_ENCODINGS,
    MAX_DEPTH_M,
    MIN_DEPTH_M,
    DepthImage,
    Intrinsics,
    depth_image_of_message,
    intrinsics_of,
)
from yolov5_lifecycle.spatial.placement import Placement, Unplaced, place
from yolov5_lifecycle.spatial.stamp_pairing import CAPACITY, DepthPairing, Unpaired

_KIND = struct.Struct("<B")
_DEPTH = struct.Struct("<qBBHHIH")
"""Stamp, index of the encoding, byte order, height, width, step and number of bytes, which follow."""
_CAMERA_INFO = struct.Struct("<8dII")
"""fx, cx, fy and cy of K, then of P; height and width."""
_STAMP = struct.Struct("<q")
_COLOUR = struct.Struct("<qHHB")
"""Stamp, height, width and number of boxes, which follow as four 32-bit floats each."""
_BOX = struct.Struct("<4f")
_SLOPS_S = (0.0, 0.02, 1.0, 1e9)
_ENCODINGS = (*DEPTH_ENCODINGS, "mono8")
_FIT = 0x80
"""Bit of the kind: the size of this message is that of the last depth image."""


def check_depth_stream(data: bytes) -> None:
    """Expect for each box a place of finite numbers or a reason, and few depth images in memory."""
    fields = Fields(data)
    (slop,) = fields.unpack(_KIND)
    stream = _Stream(_SLOPS_S[slop % len(_SLOPS_S)])
    while fields.left:
        (kind,) = fields.unpack(_KIND)
        fits = bool(kind & _FIT)
        (stream.take_depth, stream.take_camera_info, stream.expect, stream.place)[kind % 4](fields, fits)
        assert len(stream.alive) <= CAPACITY + 1, "old depth images must be freed"


class _Stream:
    """The node's state of a depth camera, and the depth images still in memory."""

    def __init__(self, slop_s: float) -> None:
        self._slop_ns = slop_s * 1e9
        self._pairing: DepthPairing[DepthImage] = DepthPairing(slop_s)
        self._intrinsics: Intrinsics | None = None
        self._size_hw = (1, 1)
        self.alive: weakref.WeakSet[DepthImage] = weakref.WeakSet()

    def take_depth(self, fields: Fields, _: bool) -> None:
        stamp_ns, encoding, is_bigendian, height, width, step, size = fields.unpack(_DEPTH)
        message = SimpleNamespace(
            header=SimpleNamespace(frame_id="depth"),
            data=fields.take(size),
            encoding=_ENCODINGS[encoding % len(_ENCODINGS)],
            height=height,
            width=width,
            step=step,
            is_bigendian=bool(is_bigendian),
        )
        if depth := taken(partial(depth_image_of_message, message), ImageError):
            assert depth.size_hw == (height, width)
            self._size_hw = depth.size_hw
            self.alive.add(depth)
            self._pairing.add(stamp_ns, depth)

    def take_camera_info(self, fields: Fields, fits: bool) -> None:
        *values, height, width = fields.unpack(_CAMERA_INFO)
        k, p = _matrix(values[:4], columns=3), _matrix(values[4:], columns=4)
        size_hw = self._size_hw if fits else (height, width)
        if intrinsics := taken(lambda: intrinsics_of(k, p, size_hw), ImageError):
            self._intrinsics = intrinsics

    def expect(self, fields: Fields, _: bool) -> None:
        self._pairing.expect(*fields.unpack(_STAMP))

    def place(self, fields: Fields, fits: bool) -> None:
        stamp_ns, height, width, count = fields.unpack(_COLOUR)
        boxes = _boxes_xyxy(fields.take(count * _BOX.size))
        paired = self._pairing.pair(stamp_ns)
        if isinstance(paired, Unpaired):
            return
        assert abs(paired.stamp_ns - stamp_ns) <= self._slop_ns
        found = place(boxes, self._size_hw if fits else (height, width), paired.item, self._intrinsics)
        assert len(found) == count
        assert all(map(_is_sound, found))


def _is_sound(found: Placement) -> bool:
    if isinstance(found, Unplaced):
        return True
    return (
        all(map(math.isfinite, (*found.centre_xyz_m, *found.size_xyz_m, found.distance_m)))
        and 0.99 * MIN_DEPTH_M <= found.centre_xyz_m[2] <= 1.01 * MAX_DEPTH_M
        and min(found.size_xyz_m) >= 0
    )


def _matrix(values: list[float], *, columns: int) -> list[float]:
    """The matrix (3, `columns`), row by row, of a camera with fx, cx, fy and cy."""
    matrix = np.zeros((3, columns))
    matrix[[0, 0, 1, 1], [0, 2, 1, 2]] = values
    return list(matrix.ravel())


def _boxes_xyxy(data: bytes) -> NDArray[np.float32]:
    """Finite boxes (n, 4) with x1 <= x2 and y1 <= y2, as a detector has them."""
    corners = np.nan_to_num(np.frombuffer(data, "<f4").astype(np.float32)).reshape(-1, 2, 2)
    return np.sort(corners, axis=1).reshape(-1, 4)


def seeds() -> Iterator[bytes]:
    """An object before a wall in each encoding, with two colour images; then many depth images."""
    height, width = 12, 16
    metres = np.full((height, width), 4.0)
    metres[3:9, 4:12] = 2.0
    box = np.array((4, 3, 12, 9), "<f4").tobytes()
    camera = _CAMERA_INFO.pack(20.0, 7.5, 20.0, 5.5, 0.0, 0.0, 0.0, 0.0, height, width)
    for number, rows in enumerate(((metres * 1000).astype("<u2"), metres.astype("<f4"))):
        row_size = width * rows.itemsize
        stamp_ns = 10**9
        depth = _DEPTH.pack(stamp_ns, number, 0, height, width, row_size, rows.nbytes) + rows.tobytes()
        colour = _COLOUR.pack(stamp_ns + 10**6, height, width, 1) + box
        yield b"\1" + b"\0" + depth + b"\1" + camera + b"\2" + _STAMP.pack(stamp_ns) + b"\3" + colour
        yield b"\2" + b"\1" + camera + b"\0" + depth + b"\0" + depth + b"\x83" + colour + b"\x83" + colour
    small = (_DEPTH.pack(number, 0, 0, 1, 1, 2, 2) + b"\1\1" for number in range(2 * CAPACITY))
    yield b"\1\2" + _STAMP.pack(0) + b"".join(b"\0" + depth for depth in small)
