"""Compressed images are decoded to the colours they were encoded from."""

from __future__ import annotations

from array import array
from typing import Any

import cv2
import numpy as np
import pytest
from support import jpeg_builder as jpeg
from support.compressed_files import image_file, smooth_bgr, smooth_file

from yolov5_lifecycle.images.compressed import decode_compressed, decode_image_file, encode_jpeg
from yolov5_lifecycle.images.encodings import decode_raw
from yolov5_lifecycle.images.image import MAX_SIDE_PX, ChannelOrder, ColourImage, ImageError


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
    assert image.channel_order == "bgr"
    np.testing.assert_allclose(image.pixels.astype(int), smooth_bgr(40, 60), atol=tolerance)


@pytest.mark.parametrize("channels", [1, 3, 4], ids=["grey", "colour", "transparent"])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16], ids=["8 bit", "16 bit"])
def test_a_png_gives_its_colours_by_their_higher_bits(
    dtype: type[np.unsignedinteger[Any]], channels: int
) -> None:
    values = np.random.default_rng(0).integers(0, np.iinfo(dtype).max, (4, 6, channels), dtype)
    high = (values >> 8 * (values.itemsize - 1)).astype(np.uint8)
    expected = np.repeat(high, 3, axis=2) if channels == 1 else high[..., :3]
    np.testing.assert_array_equal(decode_compressed(image_file(".png", values)).pixels, expected)


GREY = smooth_bgr(40, 60)[..., 2]
FILES = {
    "colour jpeg": smooth_file(".jpg"),
    "colour png": smooth_file(".png"),
    "deep colour png": image_file(".png", smooth_bgr(40, 60).astype(np.uint16) * 257),
    "grey jpeg": image_file(".jpg", GREY),
    "grey png": image_file(".png", GREY),
    "deep png": image_file(".png", GREY.astype(np.uint16) * 99),
    "tiff": image_file(".tiff", GREY),
    "nothing": b"",
}
NO_VALUES = "compressed image of '{}' is not supported. {} the publisher send colours or grey of 8 bits"
RAW = "Subscribe to the raw image, or "
NO_DEPTH = "compressedDepth, which is not supported; subscribe to the raw 16UC1 image instead.$"


@pytest.mark.parametrize(
    ("format_text", "files", "channel_order"),
    [
        *((text, "colour jpeg, colour png, grey jpeg, deep png", "bgr") for text in ("", "x" * 10_000, ";")),
        *((text, "colour jpeg, grey jpeg", "bgr") for text in ("jpeg", "jpg", "JPEG", "mjpeg", "rgb8; jpeg")),
        ("png", "colour png, deep colour png, grey png, deep png", "bgr"),
        ("rgb8; jpeg compressed bgr8", "colour jpeg", "bgr"),
        ("bgr8; jpeg compressed bgr8", "colour jpeg", "bgr"),
        ("bayer_rggb8; jpeg compressed bgr8", "colour jpeg", "bgr"),
        ("rgb8; jpeg compressed rgb8", "colour jpeg", "rgb"),
        ("bgra8; png compressed bgr8", "colour png", "bgr"),
        ("rgb16; png compressed rgb16", "deep colour png", "rgb"),
        ("8UC3; png compressed ", "colour png", "bgr"),
        ("mono8; jpeg compressed mono8", "grey jpeg", "bgr"),
        ("bayer_rggb8; jpeg compressed mono8", "grey jpeg", "bgr"),
    ],
)
def test_a_file_of_viewable_pixels_gives_its_own_colours(
    format_text: str, files: str, channel_order: ChannelOrder
) -> None:
    """Red and blue are swapped where its format says so."""
    for name in files.split(", "):
        image = decode_compressed(FILES[name], format_text=format_text)
        assert image.channel_order == channel_order
        colours = cv2.imdecode(np.frombuffer(FILES[name], np.uint8), cv2.IMREAD_COLOR)
        np.testing.assert_array_equal(image.pixels, colours)


@pytest.mark.parametrize(
    ("format_text", "name", "encoding"),
    [
        ("bayer_rggb8; jpeg compressed bayer_rggb8", "grey jpeg", "bayer_rggb8"),
        ("bayer_gbrg8; jpeg compressed ", "grey jpeg", "bayer_gbrg8"),
        ("bayer_grbg8; png compressed ", "grey png", "bayer_grbg8"),
        ("bayer_bggr8", "grey jpeg", "bayer_bggr8"),
        ("mono16; png compressed mono16", "deep png", "mono16"),
    ],
)
def test_a_file_of_values_gives_the_image_of_the_raw_image(
    format_text: str, name: str, encoding: str
) -> None:
    values = cv2.imdecode(np.frombuffer(FILES[name], np.uint8), cv2.IMREAD_UNCHANGED)
    raw = decode_raw(
        values.astype(values.dtype.newbyteorder("<")).tobytes(),
        encoding=encoding,
        height=40,
        width=60,
        step=60 * values.itemsize,
        is_bigendian=False,
    )
    image = decode_compressed(FILES[name], format_text=format_text)
    assert image.channel_order == ("bgr" if encoding == "mono16" else raw.channel_order)
    np.testing.assert_array_equal(image.pixels, raw.pixels)


def test_a_mosaic_is_read_as_stored_whatever_its_rotation() -> None:
    rotated = jpeg.with_orientation(FILES["grey jpeg"], 6)
    stored, found = (
        decode_compressed(data, format_text="bayer_rggb8").pixels for data in (FILES["grey jpeg"], rotated)
    )
    np.testing.assert_array_equal(found, stored)


@pytest.mark.parametrize(
    ("format_text", "name", "reason"),
    [
        ("mono16; jpeg compressed ", "grey jpeg", f"a PNG of mono16, found a JPEG, .* {RAW}set .* to png"),
        ("16UC1; png compressed ", "deep png", NO_VALUES.format("16UC1", f"{RAW}have")),
        ("16UC1; jpeg compressed ", "nothing", NO_VALUES.format("16UC1", f"{RAW}have")),
        (
            "16UC1; jpeg compressed mono8",
            "nothing",
            f"found 0 bytes that begin with nothing. {RAW}set .* to png",
        ),
        (
            "bayer_rggb8; jpeg compressed bayer_rggb8",
            "colour jpeg",
            f"8 bits for bayer_rggb8, found colours. {RAW}",
        ),
        ("bayer_rggb8; png compressed ", "colour png", f"found colours. {RAW}have the publisher name after"),
        ("bayer_rggb8; png compressed ", "deep png", "8 bits for bayer_rggb8, found 16 bits"),
        ("bayer_rggb16; png compressed ", "deep png", NO_VALUES.format("bayer_rggb16", "Have")),
        ("32FC1; tiff compressed ", "tiff", NO_VALUES.format("32FC1", "Have")),
        ("mono8; tiff compressed ", "tiff", f"Expected a JPEG or PNG, found .* {RAW}set .* to png"),
        ("16UC1; compressedDepth png", "deep png", NO_DEPTH),
        ("16UC1; compressedDepth rvl", "nothing", NO_DEPTH),
    ],
)
def test_a_file_that_cannot_hold_what_its_format_says_is_refused_with_what_to_do(
    format_text: str, name: str, reason: str
) -> None:
    with pytest.raises(ImageError, match=reason):
        decode_compressed(FILES[name], format_text=format_text)


@pytest.mark.parametrize("channel_order", ["rgb", "bgr"])
def test_an_image_becomes_a_jpeg_of_its_colours(channel_order: ChannelOrder) -> None:
    pixels = smooth_bgr(40, 60) if channel_order == "bgr" else smooth_bgr(40, 60)[..., ::-1]
    decoded = decode_compressed(encode_jpeg(ColourImage(pixels, channel_order)))
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
