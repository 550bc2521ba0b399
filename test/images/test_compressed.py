"""Compressed images are decoded to the colours they were encoded from."""

from __future__ import annotations

from array import array
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from support import jpeg_builder as jpeg
from support.compressed_files import smooth_bgr, smooth_file

from yolov5_lifecycle.images.compressed import decode_compressed, decode_image_file, encode_jpeg
from yolov5_lifecycle.images.encodings import decode_raw
from yolov5_lifecycle.images.image import MAX_SIDE_PX, ColourImage, ImageError, Order


@pytest.mark.parametrize(
    ("data", "tolerance"),
    [
        pytest.param(smooth_file(".png"), 0, id="png"),
        pytest.param(smooth_file(".jpg"), 10, id="jpeg"),
        pytest.param(smooth_file(".jpg", cv2.IMWRITE_JPEG_PROGRESSIVE, 1), 10, id="progressive jpeg"),
    ],
)
def test_a_compressed_image_is_decoded(data: bytes, tolerance: int) -> None:
    image = decode_compressed(array("B", data))
    assert image.order == "bgr"
    np.testing.assert_allclose(image.pixels.astype(int), smooth_bgr(40, 60), atol=tolerance)


def png(values: NDArray[np.unsignedinteger[Any]]) -> bytes:
    is_encoded, data = cv2.imencode(".png", values)
    assert is_encoded
    return bytes(data)


@pytest.mark.parametrize("channels", [1, 3, 4], ids=["grey", "colour", "transparent"])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16], ids=["8 bit", "16 bit"])
def test_a_png_gives_its_colours_by_their_higher_bits(
    dtype: type[np.unsignedinteger[Any]], channels: int
) -> None:
    values = np.random.default_rng(0).integers(0, np.iinfo(dtype).max, (4, 6, channels), dtype)
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
def test_the_format_says_whether_red_and_blue_are_swapped(
    suffix: str, format_text: str, order: Order
) -> None:
    image = decode_compressed(smooth_file(suffix), format_text=format_text)
    assert image.order == order
    np.testing.assert_allclose(image.pixels.astype(int), smooth_bgr(40, 60), atol=10)


@pytest.mark.parametrize(
    ("encoding", "dtype"), [("16UC1", np.uint16), ("bayer_rggb8", np.uint8), ("bayer_gbrg8", np.uint8)]
)
def test_a_png_of_values_gives_the_image_of_the_raw_image(
    encoding: str, dtype: type[np.unsignedinteger[Any]]
) -> None:
    values = np.random.default_rng(0).integers(
        300 if dtype is np.uint16 else 0, np.iinfo(dtype).max, (5, 7), dtype
    )
    raw = decode_raw(
        values.astype(values.dtype.newbyteorder("<")).tobytes(),
        encoding=encoding,
        height=5,
        width=7,
        step=7 * values.itemsize,
        is_bigendian=False,
    )
    image = decode_compressed(png(values), format_text=f"{encoding}; png compressed ")
    assert image.order == raw.order
    np.testing.assert_array_equal(image.pixels, raw.pixels)


def test_a_jpeg_of_a_mosaic_is_the_grey_image_that_image_transport_made_of_it() -> None:
    image = decode_compressed(smooth_file(".jpg"), format_text="bayer_rggb8; jpeg compressed mono8")
    np.testing.assert_array_equal(image.pixels, decode_compressed(smooth_file(".jpg")).pixels)


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
def test_an_image_becomes_a_jpeg_of_its_colours(order: Order) -> None:
    pixels = smooth_bgr(40, 60) if order == "bgr" else smooth_bgr(40, 60)[..., ::-1]
    decoded = decode_compressed(encode_jpeg(ColourImage(pixels, order)))
    np.testing.assert_allclose(decoded.pixels.astype(int), smooth_bgr(40, 60), atol=15)


@pytest.mark.parametrize("size_hw", [(1, 1), (1, MAX_SIDE_PX), (MAX_SIDE_PX, 1)], ids=str)
def test_an_image_of_any_size_becomes_a_jpeg(size_hw: tuple[int, int]) -> None:
    image = ColourImage(np.zeros((*size_hw, 3), np.uint8), "rgb")
    assert decode_compressed(encode_jpeg(image)).size_hw == size_hw


COLOURS = [(10, 200, 60), (250, 128, 3), (128, 128, 128), (0, 0, 255)]
INKS = [(*colour, black) for colour, black in zip(COLOURS, (255, 200, 90, 0), strict=True)]
ADOBE_YCCK = jpeg.segment(0xEE, b"Adobe" + bytes([0, 100, 0, 0, 0, 0, 2]))


@pytest.mark.parametrize(
    "data",
    [
        pytest.param(jpeg.blocks(COLOURS), id="YCbCr"),
        pytest.param(jpeg.blocks([colour[:1] for colour in COLOURS]), id="grey"),
        pytest.param(jpeg.blocks(INKS), id="CMYK"),
        pytest.param(jpeg.blocks(INKS, before_scan=ADOBE_YCCK), id="YCCK"),
    ],
)
@pytest.mark.parametrize("orientation", [None, *range(1, 9)])
def test_a_jpeg_is_as_opencv_sees_it_in_colour(data: bytes, orientation: int | None) -> None:
    """A message's image as stored, a file's image upright."""
    data = data if orientation is None else jpeg.with_orientation(data, orientation)
    buffer = np.frombuffer(data, np.uint8)
    stored = cv2.imdecode(buffer, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    upright = cv2.imdecode(buffer, cv2.IMREAD_COLOR)
    assert np.unique(stored.reshape(-1, 3), axis=0).shape[0] == len(COLOURS)
    assert (upright.shape == stored.shape) == (orientation in (None, 1, 2, 3, 4))
    np.testing.assert_array_equal(decode_compressed(data).pixels, stored)
    np.testing.assert_array_equal(decode_image_file(buffer).pixels, upright)
