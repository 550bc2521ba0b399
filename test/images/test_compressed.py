"""JPEG and PNG files become pictures and come from them, or are refused with the reason."""

from __future__ import annotations

import os
import subprocess
import sys
from array import array
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from support import jpeg_builder as jpeg
from support import png_builder
from support.colcon_workspace import REPOSITORY, SUPPORT_PATH
from support.hostile_pictures import HOSTILE_JPEGS, HOSTILE_PNGS

from yolov5_lifecycle.images.compressed import decode_compressed, decode_image_file, encode_jpeg
from yolov5_lifecycle.images.encodings import decode_raw
from yolov5_lifecycle.images.image import MAX_SIDE_PX, ImageError, Order, Picture
from yolov5_lifecycle.images.jpeg_structure import MAX_SCANNED_PX, MAX_SCANS, MAX_SEGMENTS, jpeg_size_hw
from yolov5_lifecycle.images.png_structure import MAX_CHUNKS, png_structure
from yolov5_lifecycle.process.environment import MAX_COMPRESSED_PX

Decode = Callable[[NDArray[np.uint8]], Picture]


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
        pytest.param(compressed(".png").replace(b"IDAT", b"daTA"), id="png without pixels"),
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


@pytest.mark.parametrize("decode", [decode_compressed, decode_image_file])
@pytest.mark.parametrize(("data", "reason"), HOSTILE_JPEGS.values(), ids=HOSTILE_JPEGS)
def test_a_jpeg_that_is_not_plain_is_refused(data: bytes, reason: str, decode: Decode) -> None:
    with pytest.raises(ImageError, match=reason):
        decode(np.frombuffer(data, np.uint8))


@pytest.mark.parametrize("decode", [decode_compressed, decode_image_file])
@pytest.mark.parametrize(("data", "reason"), HOSTILE_PNGS.values(), ids=HOSTILE_PNGS)
def test_a_png_that_is_not_plain_is_refused(data: bytes, reason: str, decode: Decode) -> None:
    with pytest.raises(ImageError, match=reason):
        decode(np.frombuffer(data, np.uint8))


def test_a_jpeg_at_every_limit_is_decoded() -> None:
    assert decode_compressed(jpeg.progressive(48, 64, scans=MAX_SCANS)).size_hw == (48, 64)
    assert jpeg_size_hw(np.frombuffer(jpeg.progressive(4096, 4096, MAX_SCANNED_PX >> 24), np.uint8))
    texts = jpeg.segment(0xE1, b"") * (MAX_SEGMENTS - 7)
    assert decode_compressed(jpeg.opened(texts, jpeg.frame(8, 8)) + jpeg.closed()).size_hw == (8, 8)


@pytest.mark.parametrize(
    "tail",
    [
        pytest.param(b"", id="nothing"),
        pytest.param(jpeg.SOI + jpeg.progressive(8, 8, 99) * 20, id="more images"),
        pytest.param(b"\0\0\0\x20ftypmp42" + NOISE.bytes(1 << 20), id="a video"),
        pytest.param(bytes(100), id="padding"),
    ],
)
def test_what_follows_the_end_of_a_jpeg_is_ignored(tail: bytes) -> None:
    """As phones append a second image or a video."""
    assert decode_compressed(jpeg.image(8, 16) + tail).size_hw == (8, 16)


def test_a_jpeg_may_lack_its_end_and_have_restart_markers() -> None:
    restarts = b"".join(bytes([0, 0xFF, 0xD0 + number]) for number in range(8))
    interval = jpeg.segment(0xDD, b"\0\x01")
    data = jpeg.opened(interval, jpeg.frame(8, 64)) + jpeg.scan([1, 2, 3], jpeg.EVERY_COEFFICIENT, restarts)
    assert decode_compressed(data).size_hw == (8, 64)


@pytest.mark.parametrize("place", ["before", "after"])
def test_compressed_texts_and_profiles_of_a_png_are_not_decompressed(place: str) -> None:
    chunks = png_builder.text_bomb(3, mb=1) + png_builder.chunk(b"iCCP", b"x\0\0" + bytes(9))
    data = png_builder.image(8, 9, **{place: chunks})
    plain = png_builder.image(8, 9)
    assert png_structure(np.frombuffer(data, np.uint8)).pixels_alone.tobytes() == plain
    assert decode_compressed(data).size_hw == (8, 9)


def test_a_plain_png_is_not_copied() -> None:
    data = np.frombuffer(png_builder.image(8, 9) + bytes(20), np.uint8)
    alone = png_structure(data).pixels_alone
    assert alone.base is not None
    assert alone.size == data.size - 20


def test_the_still_image_of_an_animated_png_is_decoded() -> None:
    frame = png_builder.animation(8, 9)
    np.testing.assert_array_equal(
        decode_compressed(png_builder.image(8, 9, before=frame)).pixels, np.zeros((8, 9, 3))
    )


PIECES = [
    jpeg.SOI,
    jpeg.EOI,
    jpeg.tables(),
    jpeg.frame(8, 16),
    jpeg.frame(24, 8),
    jpeg.frame(16, 8, marker=jpeg.PROGRESSIVE, components=1),
    jpeg.scan([1, 2, 3], jpeg.EVERY_COEFFICIENT),
    jpeg.scan([1], jpeg.FIRST_COEFFICIENT),
    jpeg.segment(0xE0, jpeg.frame(40, 40)),
    *(b"\xff\x01", b"\xff\xd0", b"\xff\0", b"\xff", b"\0\x10", b"\xff\xdc\0\x04\0\x08"),
]


@settings(max_examples=200)
@given(st.lists(st.sampled_from(PIECES), max_size=12).map(b"".join))
@example(jpeg.SOI + jpeg.tables() + jpeg.frame(8, 16) + jpeg.closed())
def test_opencv_decodes_no_other_size_than_the_one_that_was_checked(rest: bytes) -> None:
    data = np.frombuffer(jpeg.SOI + jpeg.tables() + rest, np.uint8)
    try:
        size_hw = jpeg_size_hw(data)
    except ImageError:
        return
    pixels = cv2.imdecode(data, cv2.IMREAD_COLOR)
    assert pixels is None or pixels.shape[:2] == size_hw


LIMITED = """
from yolov5_lifecycle.process.environment import prepare_environment
prepare_environment()
import cv2, numpy
from support import jpeg_builder
try:
    cv2.imdecode(numpy.frombuffer(jpeg_builder.image(8193, 8192), numpy.uint8), cv2.IMREAD_COLOR)
except cv2.error as error:
    print("refused" if "CV_IO_MAX_IMAGE_PIXELS" in str(error) else error)
"""


def test_opencv_itself_refuses_larger_images_in_our_processes() -> None:
    environment = {**os.environ, **SUPPORT_PATH}
    environment.pop("OPENCV_IO_MAX_IMAGE_PIXELS", None)
    run = subprocess.run(
        [sys.executable, "-c", LIMITED], capture_output=True, text=True, timeout=60, env=environment
    )
    assert run.stdout == "refused\n", run.stderr


@pytest.mark.parametrize(
    "told",
    [
        f"{MAX_COMPRESSED_PX:,} pixels, sides of {MAX_SIDE_PX:,} pixels",
        f"{MAX_SEGMENTS:,} segments",
        f"{MAX_SCANS} scans; scans x pixels at most {MAX_SCANNED_PX:,}",
        f"{MAX_CHUNKS:,} chunks",
    ],
)
def test_the_page_has_the_limits_of_the_code(told: str) -> None:
    assert told in (REPOSITORY / "docs" / "images.md").read_text()


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
