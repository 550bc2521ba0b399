"""Buffers become pictures, or are refused with the reason."""

from __future__ import annotations

from array import array
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from yolov5_lifecycle.images import (
    ENCODINGS,
    MAX_COMPRESSED_PX,
    MAX_SIDE_PX,
    ImageError,
    Picture,
    decode_compressed,
    decode_raw,
)

# Two rows of two pixels, each with red 1, green 2, blue 3 and more by 10, 20, 30.
RGB = np.array([[[1, 2, 3], [11, 12, 13]], [[21, 22, 23], [31, 32, 33]]], np.uint8)
ALPHA = np.full((2, 2, 1), 255, np.uint8)
GREY = np.array([[[1], [11]], [[21], [31]]], np.uint8)
AS_SENT: dict[str, NDArray[np.uint8]] = {
    "rgb8": RGB,
    "bgr8": RGB[..., ::-1],
    "mono8": GREY,
    "rgba8": np.concatenate((RGB, ALPHA), axis=2),
    "bgra8": np.concatenate((RGB[..., ::-1], ALPHA), axis=2),
}


def decode(data: Any, **layout: Any) -> Picture:
    """Decode two rows of two rgb8 pixels unless `layout` says otherwise."""
    usual: dict[str, Any] = {"encoding": "rgb8", "height": 2, "width": 2, "step": 6, "is_bigendian": False}
    return decode_raw(data, **usual | layout)


def in_rgb(picture: Picture) -> NDArray[np.uint8]:
    return picture.pixels if picture.order == "rgb" else picture.pixels[..., ::-1]


def test_every_encoding_has_its_sample() -> None:
    assert AS_SENT.keys() == ENCODINGS.keys()


@pytest.mark.parametrize("padding", [0, 1, 13], ids=lambda padding: f"padded by {padding}")
@pytest.mark.parametrize("is_bigendian", [False, True], ids=["little", "big"])
@pytest.mark.parametrize("encoding", AS_SENT)
def test_every_encoding_gives_its_colours(encoding: str, is_bigendian: bool, padding: int) -> None:
    rows = AS_SENT[encoding].reshape(2, -1)
    padded = np.pad(rows, ((0, 0), (0, padding)), constant_values=99)
    step = padded.shape[1]
    data = padded.tobytes()[: step + rows.shape[1]]  # the last row may come without its padding
    picture = decode(data, encoding=encoding, step=step, is_bigendian=is_bigendian)
    expected = np.repeat(GREY, 3, axis=2) if encoding == "mono8" else RGB
    np.testing.assert_array_equal(in_rgb(picture), expected)
    assert picture.size_hw == (2, 2)


@pytest.mark.parametrize(
    "buffer",
    [
        pytest.param(bytes, id="bytes"),
        pytest.param(bytearray, id="bytearray"),
        pytest.param(memoryview, id="memoryview"),
        pytest.param(lambda data: array("B", data), id="array of bytes"),
        pytest.param(lambda data: array("H", data), id="array of words"),
        pytest.param(lambda data: np.frombuffer(data, np.uint8), id="ndarray"),
        pytest.param(lambda data: np.frombuffer(data, np.uint8).reshape(3, 4), id="matrix"),
    ],
)
def test_any_contiguous_buffer_will_do(buffer: Callable[[bytes], object]) -> None:
    np.testing.assert_array_equal(in_rgb(decode(buffer(RGB.tobytes()))), RGB)


@pytest.mark.parametrize("encoding", ["rgb8", "bgr8"])
def test_three_colours_are_viewed_not_copied_and_cannot_be_written(encoding: str) -> None:
    data = array("B", AS_SENT[encoding].tobytes())
    picture = decode(data, encoding=encoding)
    assert np.shares_memory(picture.pixels, np.frombuffer(data, np.uint8))
    with pytest.raises(ValueError, match="read-only"):
        picture.pixels[0, 0, 0] = 0


def test_bytes_after_the_picture_are_left_alone() -> None:
    np.testing.assert_array_equal(decode(RGB.tobytes() + b"more").pixels, RGB)


@pytest.mark.parametrize("encoding", ["bayer_rggb8", "16UC1", "yuv422", "RGB8", "", "x" * 10_000, "8UC3"])
def test_another_encoding_is_refused_with_what_is_supported(encoding: str) -> None:
    with pytest.raises(
        ImageError, match="not supported; supported: rgb8, bgr8, mono8, rgba8, bgra8"
    ) as error:
        decode(RGB.tobytes(), encoding=encoding)
    assert encoding[:40] in str(error.value)
    assert len(str(error.value)) < 200


@pytest.mark.parametrize(
    ("layout", "reason"),
    [
        pytest.param({"height": 0}, "1 to 16384 pixels, found 0 x 2", id="no rows"),
        pytest.param({"width": 0}, "1 to 16384 pixels, found 2 x 0", id="no columns"),
        pytest.param({"height": -1}, "found -1 x 2", id="negative height"),
        pytest.param({"height": MAX_SIDE_PX + 1}, "found 16385 x 2", id="too high"),
        pytest.param({"width": 2**32 - 1, "step": 2**32 - 1}, "found 2 x 4294967295", id="too wide"),
        pytest.param({"step": 5}, "step >= 6, found 5", id="rows overlap"),
        pytest.param({"step": 0}, "step >= 6, found 0", id="no step"),
        pytest.param({"height": 3}, "need 18 bytes, found 12", id="a row too few"),
        pytest.param({"step": 7}, "need 13 bytes, found 12", id="a byte too few"),
        pytest.param({"step": 2**32 - 1}, "need 4294967301 bytes, found 12", id="a huge step"),
        pytest.param({"encoding": "rgba8"}, "step >= 8, found 6", id="four channels in the room of three"),
    ],
)
def test_a_layout_that_does_not_fit_is_refused_with_both_numbers(layout: dict[str, Any], reason: str) -> None:
    with pytest.raises(ImageError, match=reason):
        decode(RGB.tobytes(), **layout)


@pytest.mark.parametrize(
    "data",
    [
        pytest.param([1] * 12, id="list"),
        pytest.param("a" * 12, id="text"),
        pytest.param(None, id="nothing"),
        pytest.param(np.zeros((2, 12), np.uint8)[:, ::2], id="not contiguous"),
    ],
)
def test_what_is_no_contiguous_buffer_is_refused(data: object) -> None:
    with pytest.raises(ImageError, match=f"contiguous buffer of bytes, found {type(data).__name__}"):
        decode(data)


def test_an_empty_buffer_is_refused() -> None:
    with pytest.raises(ImageError, match="need 12 bytes, found 0"):
        decode(b"")


numbers = st.integers(-1, 20) | st.integers(-(2**63), 2**64)


@settings(deadline=None)
@given(
    size=st.integers(0, 300),
    encoding=st.sampled_from([*ENCODINGS, "16UC1"]),
    height=numbers,
    width=numbers,
    step=numbers,
)
def test_hostile_numbers_give_a_picture_or_an_image_error(
    size: int, encoding: str, height: int, width: int, step: int
) -> None:
    try:
        picture = decode(bytes(size), encoding=encoding, height=height, width=width, step=step)
    except ImageError:
        return
    assert picture.size_hw == (height, width)
    assert not picture.pixels.any()  # reads every pixel


@pytest.mark.parametrize(
    "pixels",
    [
        np.zeros((2, 2), np.uint8),
        np.zeros((2, 2, 4), np.uint8),
        np.zeros((2, 2, 3)),
        np.zeros((0, 2, 3), np.uint8),
    ],
    ids=["two axes", "four channels", "float", "no rows"],
)
def test_a_picture_of_other_pixels_is_refused(pixels: NDArray[Any]) -> None:
    with pytest.raises(ImageError, match="found"):
        Picture(pixels, "rgb")


def smooth_bgr(height: int, width: int) -> NDArray[np.uint8]:
    rows, columns = np.mgrid[:height, :width]
    return np.stack((rows, columns, rows + columns), axis=2).astype(np.uint8)


def compressed(suffix: str, *flags: int) -> bytes:
    is_encoded, data = cv2.imencode(suffix, smooth_bgr(40, 60), flags)
    assert is_encoded
    return bytes(data)


@pytest.mark.parametrize(
    ("data", "tolerance"),
    [
        pytest.param(compressed(".png"), 0, id="png"),
        pytest.param(compressed(".jpg"), 10, id="jpeg"),
        pytest.param(compressed(".jpg", cv2.IMWRITE_JPEG_PROGRESSIVE, 1), 10, id="progressive jpeg"),
    ],
)
def test_a_compressed_picture_is_decoded(data: bytes, tolerance: int) -> None:
    picture = decode_compressed(array("B", data))
    assert picture.order == "bgr"
    np.testing.assert_allclose(picture.pixels.astype(int), smooth_bgr(40, 60), atol=tolerance)


def test_a_grey_compressed_picture_has_three_channels() -> None:
    grey = cv2.imencode(".png", smooth_bgr(4, 6)[..., 0])[1]
    np.testing.assert_array_equal(
        decode_compressed(grey).pixels, np.repeat(smooth_bgr(4, 6)[..., :1], 3, axis=2)
    )


def test_the_rotation_a_jpeg_asks_for_is_not_made() -> None:
    exif = b"Exif\0\0II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0\x06\0\0\0\0\0\0\0"  # orientation 6
    segment = b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif
    data = compressed(".jpg")
    assert decode_compressed(data[:2] + segment + data[2:]).size_hw == (40, 60)


def test_a_jpeg_may_have_fill_bytes_and_a_table_before_its_frame_header() -> None:
    data = compressed(".jpg")
    table = b"\xff\xc4" + (19).to_bytes(2, "big") + b"\x03" + bytes(16)  # an empty Huffman table
    assert decode_compressed(data[:2] + table + b"\xff\xff" + data[2:]).size_hw == (40, 60)


def claiming(data: bytes, height: int, width: int) -> bytes:
    """That PNG or JPEG with another size in its header."""
    if data[:4] == b"\x89PNG":
        return data[:16] + width.to_bytes(4, "big") + height.to_bytes(4, "big") + data[24:]
    frame = data.index(b"\xff\xc0") + 5
    return data[:frame] + height.to_bytes(2, "big") + width.to_bytes(2, "big") + data[frame + 4 :]


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
@pytest.mark.parametrize(
    ("height", "width", "reason"),
    [
        pytest.param(8193, 8192, f"{MAX_COMPRESSED_PX} pixels, this one claims 8193 x 8192", id="too many"),
        pytest.param(65535, 1, "found 65535 x 1", id="too high"),
        pytest.param(0, 1, "found 0 x 1", id="none"),
    ],
)
def test_a_compressed_picture_that_claims_a_wild_size_is_not_decoded(
    suffix: str, height: int, width: int, reason: str
) -> None:
    with pytest.raises(ImageError, match=reason):
        decode_compressed(claiming(compressed(suffix), height, width))


@pytest.mark.parametrize(
    "data",
    [
        pytest.param(b"", id="nothing"),
        pytest.param(b"\xff\xd8", id="jpeg without header"),
        pytest.param(b"\xff\xd8\xff\xe0\x00\x00" * 9, id="jpeg with empty segments"),
        pytest.param(b"\x89PNG\r\n\x1a\n", id="png without header"),
        pytest.param(b"GIF89a" + bytes(100), id="gif"),
        pytest.param(compressed(".bmp"), id="bmp"),
        pytest.param(compressed(".png")[:60], id="half a png"),
        pytest.param(compressed(".png")[:33], id="png of a header alone"),
        pytest.param(compressed(".png").replace(b"IDAT", b"DATA"), id="png without pixels"),
        pytest.param(compressed(".jpg")[:30], id="a piece of a jpeg"),
    ],
)
def test_what_is_no_jpeg_or_png_is_refused(data: bytes) -> None:
    with pytest.raises(ImageError, match=f"found {len(data)} bytes"):
        decode_compressed(data)


def test_a_png_that_claims_a_huge_chunk_is_not_decoded() -> None:
    data = compressed(".png")
    with pytest.raises(ImageError, match="within a chunk"):
        decode_compressed(data[:33] + b"\xff\xff\xff\xff" + data[37:])


@settings(deadline=None)
@given(
    data=st.sampled_from([compressed(".png"), compressed(".jpg")]),
    position=st.integers(0, 700),
    damage=st.binary(max_size=40),
)
def test_a_damaged_file_gives_a_picture_or_an_image_error(data: bytes, position: int, damage: bytes) -> None:
    damaged = data[:position] + damage + data[position + len(damage) :]
    try:
        picture = decode_compressed(damaged)
    except ImageError:
        return
    assert max(picture.size_hw) <= MAX_SIDE_PX
