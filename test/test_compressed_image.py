"""JPEG and PNG files become pictures and come from them, or are refused with the reason."""

from __future__ import annotations

from array import array
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from yolov5_lifecycle.compressed_image import MAX_COMPRESSED_PX, decode_compressed, encode_jpeg
from yolov5_lifecycle.images import MAX_SIDE_PX, ImageError, Order, Picture
from yolov5_lifecycle.raw_image import decode_raw


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


NOISE = np.random.default_rng(0)


def png(values: NDArray[np.unsignedinteger[Any]]) -> bytes:
    is_encoded, data = cv2.imencode(".png", values)
    assert is_encoded
    return bytes(data)


@pytest.mark.parametrize("channels", [1, 3, 4], ids=["grey", "colour", "transparent"])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16], ids=["8 bit", "16 bit"])
def test_a_png_gives_its_colours_by_their_higher_bits(
    dtype: type[np.unsignedinteger[Any]], channels: int
) -> None:
    values = NOISE.integers(0, np.iinfo(dtype).max, (4, 6, channels), dtype)
    high = (values >> 8 * (values.itemsize - 1)).astype(np.uint8)
    expected = np.repeat(high, 3, axis=2) if channels == 1 else high[..., :3]
    np.testing.assert_array_equal(decode_compressed(png(values)).pixels, expected)


def test_a_grey_jpeg_has_three_channels() -> None:
    grey = cv2.imencode(".jpg", np.full((8, 8), 77, np.uint8))[1]
    np.testing.assert_array_equal(decode_compressed(grey).pixels, np.full((8, 8, 3), 77))


@pytest.mark.parametrize(
    ("format_text", "order"),
    [
        ("", "bgr"),
        ("jpeg", "bgr"),
        ("rgb8; jpeg compressed bgr8", "bgr"),
        ("bgr8; png compressed bgr8", "bgr"),
        ("bgra8; png compressed bgr8", "bgr"),
        ("mono8; jpeg compressed mono8", "bgr"),
        ("mono16; png compressed ", "bgr"),
        ("rgb8; jpeg compressed ", "bgr"),
        ("rgb8; jpeg compressed rgb8", "rgb"),
        ("x" * 10_000, "bgr"),
    ],
)
@pytest.mark.parametrize("suffix", [".jpg", ".png"])
def test_the_format_tells_what_took_red_for_blue(suffix: str, format_text: str, order: Order) -> None:
    picture = decode_compressed(compressed(suffix), format_text=format_text)
    assert picture.order == order
    np.testing.assert_allclose(picture.pixels.astype(int), smooth_bgr(40, 60), atol=10)


@pytest.mark.parametrize(
    ("encoding", "dtype"), [("16UC1", np.uint16), ("bayer_rggb8", np.uint8), ("bayer_gbrg8", np.uint8)]
)
def test_a_png_of_values_gives_the_picture_of_the_raw_image(
    encoding: str, dtype: type[np.unsignedinteger[Any]]
) -> None:
    values = NOISE.integers(300 if dtype is np.uint16 else 0, np.iinfo(dtype).max, (5, 7), dtype)
    raw = decode_raw(
        values.astype(values.dtype.newbyteorder("<")).tobytes(),
        encoding=encoding,
        height=5,
        width=7,
        step=7 * values.itemsize,
        is_bigendian=False,
    )
    picture = decode_compressed(png(values), format_text=f"{encoding}; png compressed ")
    assert picture.order == raw.order
    np.testing.assert_array_equal(picture.pixels, raw.pixels)


def test_a_jpeg_of_a_mosaic_is_the_grey_picture_that_image_transport_made_of_it() -> None:
    picture = decode_compressed(compressed(".jpg"), format_text="bayer_rggb8; jpeg compressed mono8")
    np.testing.assert_array_equal(picture.pixels, decode_compressed(compressed(".jpg")).pixels)


@pytest.mark.parametrize(
    ("dtype", "encoding", "reason"),
    [
        (np.uint8, "16UC1", "uint16 values for 16UC1, found uint8"),
        (np.uint16, "bayer_rggb8", "uint8 values for bayer_rggb8, found uint16"),
    ],
)
def test_a_png_of_other_values_than_its_format_says_is_refused(
    dtype: type[np.unsignedinteger[Any]], encoding: str, reason: str
) -> None:
    with pytest.raises(ImageError, match=reason):
        decode_compressed(png(np.zeros((4, 4), dtype)), format_text=f"{encoding}; png compressed ")


@pytest.mark.parametrize("format_text", ["16UC1; compressedDepth png", "32FC1; compressedDepth"])
def test_compressed_depth_is_refused_with_what_to_use_instead(format_text: str) -> None:
    with pytest.raises(ImageError, match=f"{format_text}.*compressedDepth, which is not supported.*raw"):
        decode_compressed(bytes(12) + png(np.zeros((4, 4), np.uint16)), format_text=format_text)


@pytest.mark.parametrize("order", ["rgb", "bgr"])
def test_a_picture_becomes_a_jpeg_of_its_colours(order: Order) -> None:
    pixels = smooth_bgr(40, 60) if order == "bgr" else smooth_bgr(40, 60)[..., ::-1]
    decoded = decode_compressed(encode_jpeg(Picture(pixels, order)))
    np.testing.assert_allclose(decoded.pixels.astype(int), smooth_bgr(40, 60), atol=15)


@pytest.mark.parametrize("size_hw", [(1, 1), (1, MAX_SIDE_PX), (MAX_SIDE_PX, 1)], ids=str)
def test_a_picture_of_any_size_becomes_a_jpeg(size_hw: tuple[int, int]) -> None:
    picture = Picture(np.zeros((*size_hw, 3), np.uint8), "rgb")
    assert decode_compressed(encode_jpeg(picture)).size_hw == size_hw


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
