"""Message buffers become depth images in metres, or are refused with the reason."""

from __future__ import annotations

from array import array
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from yolov5_lifecycle.images.image import MAX_SIDE_PX, ImageError
from yolov5_lifecycle.spatial.depth_image import (
    DEPTH_ENCODINGS,
    MAX_DEPTH_M,
    MIN_DEPTH_M,
    DepthImage,
    depth_image_of_message,
)

both_encodings = pytest.mark.parametrize("encoding", DEPTH_ENCODINGS)
both_orders = pytest.mark.parametrize("is_bigendian", [False, True], ids=["little endian", "big endian"])


def sent(metres: NDArray[np.float64], encoding: str, *, is_bigendian: bool, padding: int = 0) -> bytes:
    """The buffer of an image message, its last row without padding."""
    order = ">" if is_bigendian else "<"
    values = (
        (metres * 1000).round().astype(f"{order}u2") if encoding == "16UC1" else metres.astype(f"{order}f4")
    )
    return (b"\xaa" * padding).join(row.tobytes() for row in values)


def decoded(data: Any, **layout: Any) -> DepthImage:
    """Decode two rows of three 16UC1 pixels unless `layout` says otherwise."""
    usual: dict[str, Any] = {"encoding": "16UC1", "height": 2, "width": 3, "step": 6, "is_bigendian": False}
    header = SimpleNamespace(frame_id="depth")
    return depth_image_of_message(SimpleNamespace(header=header, data=data, **usual | layout))


def all_metres(depth: DepthImage) -> NDArray[np.float32]:
    height, width = depth.size_hw
    return depth.metres_at(np.arange(height)[:, None], np.arange(width)[None, :])


@pytest.mark.long
@both_encodings
@both_orders
@given(
    millimetres=st.lists(st.integers(10, 65535), min_size=1, max_size=24),
    width=st.integers(1, 6),
    padding=st.integers(0, 5),
)
def test_every_encoding_and_byte_order_gives_the_same_metres(
    encoding: str, is_bigendian: bool, millimetres: list[int], width: int, padding: int
) -> None:
    height = -(-len(millimetres) // width)
    metres = np.resize(np.array(millimetres), (height, width)) / 1000
    depth = decoded(
        sent(metres, encoding, is_bigendian=is_bigendian, padding=padding),
        encoding=encoding,
        height=height,
        width=width,
        step=width * np.dtype(DEPTH_ENCODINGS[encoding][0]).itemsize + padding,
        is_bigendian=is_bigendian,
    )
    assert depth.size_hw == (height, width)
    np.testing.assert_allclose(all_metres(depth), metres, rtol=1e-6)


@pytest.mark.parametrize(
    "value", [0.0, -1.0, np.nan, np.inf, -np.inf, MIN_DEPTH_M / 2, MAX_DEPTH_M * 2, np.float32(3e38)]
)
def test_what_is_no_measurement_is_nan(value: float) -> None:
    metres = np.array([[value, 1.5]])
    depth = decoded(sent(metres, "32FC1", is_bigendian=False), encoding="32FC1", height=1, width=2, step=8)
    np.testing.assert_array_equal(all_metres(depth), [[np.nan, 1.5]])


@given(data=st.binary(min_size=24, max_size=24), is_bigendian=st.booleans())
def test_any_bytes_are_metres_in_range_or_nan(data: bytes, is_bigendian: bool) -> None:
    metres = all_metres(decoded(data, encoding="32FC1", step=12, is_bigendian=is_bigendian))
    valid = metres[~np.isnan(metres)]
    assert ((valid >= MIN_DEPTH_M * 0.999) & (valid <= MAX_DEPTH_M)).all()


def test_every_pixel_is_measured_and_none_outside_the_image() -> None:
    rows, columns = np.array([(-1, 0), (2, 0), (0, -1), (0, 3), (-(10**12), 10**12)]).T
    depth = decoded(b"\x01\x01" * 6)
    assert np.isnan(depth.metres_at(rows, columns)).all()
    assert not np.isnan(all_metres(depth)).any()


def test_the_image_is_a_read_only_view_of_the_message() -> None:
    data = array("B", b"\x01\x02" * 6)
    depth = decoded(data)
    assert np.shares_memory(depth.values, np.frombuffer(data, np.uint8))
    assert not depth.values.flags.writeable


@pytest.mark.parametrize(
    ("layout", "message"),
    [
        pytest.param({"encoding": "rgb8"}, "16UC1 or 32FC1, found encoding 'rgb8'", id="colour"),
        pytest.param({"width": MAX_SIDE_PX + 1}, "found 2 x 16385", id="too wide"),
        pytest.param({"step": 5}, "need a step >= 6, found 5", id="short step"),
        pytest.param({"step": 7}, "with step 7 need 13 bytes, found 12", id="short buffer"),
    ],
)
def test_a_layout_that_does_not_fit_is_refused(layout: dict[str, Any], message: str) -> None:
    with pytest.raises(ImageError, match=message):
        decoded(bytes(12), **layout)
