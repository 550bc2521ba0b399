"""Buffers in every encoding become images, or are refused with the reason."""

from __future__ import annotations

from array import array
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from yolov5_lifecycle.images.encodings import ENCODINGS, decode_raw
from yolov5_lifecycle.images.image import MAX_SIDE_PX, ColourImage, ImageError

# Two rows of two pixels, each with red 1, green 2, blue 3 and more by 10, 20, 30.
RGB = np.array([[[1, 2, 3], [11, 12, 13]], [[21, 22, 23], [31, 32, 33]]], np.uint8)
Rgb = tuple[float, float, float]


def decode(data: Any, **layout: Any) -> ColourImage:
    """Decode two rows of two rgb8 pixels unless `layout` says otherwise."""
    usual: dict[str, Any] = {"encoding": "rgb8", "height": 2, "width": 2, "step": 6, "is_bigendian": False}
    return decode_raw(data, **usual | layout)


def in_rgb(image: ColourImage) -> NDArray[np.uint8]:
    return image.pixels if image.channel_order == "rgb" else image.pixels[..., ::-1]


class Sent(NamedTuple):
    """An image message's buffer and layout; the slow way to its pixels."""

    data: bytes
    height: int
    width: int
    step: int
    is_bigendian: bool

    def decoded(self, encoding: str) -> ColourImage:
        return decode_raw(encoding=encoding, **self._asdict())

    def byte(self, row: int, position: int) -> int:
        return self.data[row * self.step + position]

    def word(self, row: int, column: int) -> int:
        pair = self.data[row * self.step + 2 * column :][:2]
        return int.from_bytes(pair, "big" if self.is_bigendian else "little")


def rgb_of_yuv(y: int, u: int, v: int) -> Rgb:
    """ITU-R BT.601, luma from 16 to 235, chroma from 16 to 240; less than black is black."""
    luma = 255 / 219 * (max(y, 16) - 16)
    blue, red = 255 / 224 * (u - 128), 255 / 224 * (v - 128)
    return luma + 1.402 * red, luma - 0.344136 * blue - 0.714136 * red, luma + 1.772 * blue


def grey(value: float) -> Rgb:
    return value, value, value


def channels(*places: int) -> Callable[[Sent, int, int], Rgb]:
    """Pixels of `places[0]` bytes; red, green and blue are at the other places."""
    size, red, green, blue = places

    def pixel(sent: Sent, row: int, column: int) -> Rgb:
        first = column * size
        return (
            sent.byte(row, first + red),
            sent.byte(row, first + green),
            sent.byte(row, first + blue),
        )

    return pixel


def chroma_pairs(y: int, u: int, v: int) -> Callable[[Sent, int, int], Rgb]:
    """Two pixels in four bytes: where the first one's luma is, and both chroma values."""

    def pixel(sent: Sent, row: int, column: int) -> Rgb:
        first = column // 2 * 4
        return rgb_of_yuv(
            sent.byte(row, first + y + column % 2 * 2), sent.byte(row, first + u), sent.byte(row, first + v)
        )

    return pixel


def half_chroma(u: int, v: int) -> Callable[[Sent, int, int], Rgb]:
    """A luma plane, then one pair of chroma values for four pixels."""

    def pixel(sent: Sent, row: int, column: int) -> Rgb:
        below, pair = sent.height + row // 2, column // 2 * 2
        return rgb_of_yuv(sent.byte(row, column), sent.byte(below, pair + u), sent.byte(below, pair + v))

    return pixel


def high_byte(sent: Sent, row: int, column: int) -> Rgb:
    return grey(sent.word(row, column) // 256)


def stretched(sent: Sent, row: int, column: int) -> Rgb:
    words = [sent.word(y, x) for y in range(sent.height) for x in range(sent.width)]
    least, span = min(words), max(words) - min(words)
    return grey((sent.word(row, column) - least) / span * 255 if span else 0)


def mosaic(pattern: str) -> Callable[[Sent, int, int], Rgb]:
    """Of each colour the mean of its nearest sensor cells; `pattern` is the first two rows."""

    def cell(row: int, column: int) -> str:
        return pattern[row % 2 * 2 + column % 2]

    def pixel(sent: Sent, row: int, column: int) -> Rgb:
        # OpenCV repeats the pixels beside the edge.
        row, column = (
            min(max(place, 1), side - 2) for place, side in ((row, sent.height), (column, sent.width))
        )
        near = [(y, x) for y in range(row - 1, row + 2) for x in range(column - 1, column + 2)]
        means = []
        for colour in "rgb":
            at = [(row, column)] if cell(row, column) == colour else near
            values = [sent.byte(y, x) for y, x in at if cell(y, x) == colour]
            means.append(sum(values) / len(values))
        return means[0], means[1], means[2]

    return pixel


REFERENCES: dict[str, Callable[[Sent, int, int], Rgb]] = {
    "rgb8": channels(3, 0, 1, 2),
    "bgr8": channels(3, 2, 1, 0),
    "8UC3": channels(3, 2, 1, 0),
    "rgba8": channels(4, 0, 1, 2),
    "bgra8": channels(4, 2, 1, 0),
    "mono8": channels(1, 0, 0, 0),
    "8UC1": channels(1, 0, 0, 0),
    "mono16": high_byte,
    "16UC1": stretched,
    "uyvy": chroma_pairs(1, 0, 2),
    "yuv422": chroma_pairs(1, 0, 2),
    "yuyv": chroma_pairs(0, 1, 3),
    "yuv422_yuy2": chroma_pairs(0, 1, 3),
    "nv12": half_chroma(0, 1),
    "nv21": half_chroma(1, 0),
    "bayer_rggb8": mosaic("rggb"),
    "bayer_bggr8": mosaic("bggr"),
    "bayer_gbrg8": mosaic("gbrg"),
    "bayer_grbg8": mosaic("grbg"),
}
EXACT = {"rgb8", "bgr8", "8UC3", "rgba8", "bgra8", "mono8", "8UC1", "mono16"}
every_encoding = pytest.mark.parametrize("encoding", ENCODINGS)


@st.composite
def sent_images(draw: st.DrawFn, encoding: str) -> Sent:
    """Noise that fits `encoding`."""
    layout = ENCODINGS[encoding]
    height, width = (max(block * draw(st.integers(1, 7)), layout.min_side_px) for block in layout.block_hw)
    row_size = width * layout.pixel_bytes
    step = row_size + draw(st.sampled_from([0, 1, 13]))
    size = step * (int(height * layout.rows) - 1) + row_size
    noise = np.random.default_rng(draw(st.integers(0, 2**32))).integers(0, 256, size, np.uint8)
    return Sent(noise.tobytes(), height, width, step, draw(st.booleans()))


@every_encoding
@settings(max_examples=15)
@given(data=st.data())
def test_every_pixel_is_what_the_slow_reference_says(encoding: str, data: st.DataObject) -> None:
    sent = data.draw(sent_images(encoding))
    image = sent.decoded(encoding)
    assert image.size_hw == (sent.height, sent.width)
    expected = [
        [REFERENCES[encoding](sent, row, column) for column in range(sent.width)]
        for row in range(sent.height)
    ]
    tolerance = 0 if encoding in EXACT else 1
    np.testing.assert_allclose(in_rgb(image).astype(float), np.clip(expected, 0, 255), atol=tolerance)


@pytest.mark.parametrize("encoding", ["rgb8", "bgr8", "8UC3"])
def test_three_colours_are_viewed_not_copied_and_cannot_be_written(encoding: str) -> None:
    data = array("B", RGB.tobytes())
    image = decode(data, encoding=encoding)
    assert np.shares_memory(image.pixels, np.frombuffer(data, np.uint8))
    with pytest.raises(ValueError, match="read-only"):
        image.pixels[0, 0, 0] = 0


@pytest.mark.parametrize("encoding", ["yuv444", "32FC1", "bayer_rggb16", "RGB8", "", "x" * 10_000, "8UC4"])
def test_another_encoding_is_refused_with_what_is_supported(encoding: str) -> None:
    with pytest.raises(ImageError, match=f"not supported; supported: {', '.join(ENCODINGS)}") as error:
        decode(RGB.tobytes(), encoding=encoding)
    assert encoding[:40] in str(error.value)
    assert len(str(error.value)) < 300


@pytest.mark.parametrize(
    ("layout", "reason"),
    [
        pytest.param({"height": 0}, "1 to 16384 pixels, found 0 x 2", id="no rows"),
        pytest.param({"height": MAX_SIDE_PX + 1}, "found 16385 x 2", id="too high"),
        pytest.param({"width": 2**32 - 1, "step": 2**32 - 1}, "found 2 x 4294967295", id="too wide"),
        pytest.param({"step": 5}, "step >= 6, found 5", id="rows overlap"),
        pytest.param({"height": 3}, "need 18 bytes, found 12", id="a row too few"),
        pytest.param({"encoding": "mono16", "step": 3}, "step >= 4, found 3", id="a byte for each word"),
        pytest.param({"encoding": "yuyv", "width": 3}, "blocks of 1 x 2.*found 2 x 3", id="half a pair"),
        pytest.param({"encoding": "nv12", "step": 6}, "need 14 bytes, found 12", id="no room for chroma"),
        pytest.param({"encoding": "bayer_rggb8"}, "at least 3 pixels, found 2 x 2", id="a tiny mosaic"),
    ],
)
def test_a_layout_that_does_not_fit_is_refused_with_both_numbers(layout: dict[str, Any], reason: str) -> None:
    with pytest.raises(ImageError, match=reason):
        decode(RGB.tobytes(), **layout)


@every_encoding
@settings(max_examples=15)
@given(data=st.data())
def test_a_byte_too_few_is_refused(encoding: str, data: st.DataObject) -> None:
    sent = data.draw(sent_images(encoding))
    with pytest.raises(ImageError, match=f"found {len(sent.data) - 1}"):
        sent._replace(data=sent.data[:-1]).decoded(encoding)


numbers = st.integers(-1, 20) | st.integers(-(2**63), 2**64)


@given(
    size=st.integers(0, 300),
    encoding=st.sampled_from([*ENCODINGS, "32FC1"]),
    height=numbers,
    width=numbers,
    step=numbers,
)
def test_hostile_numbers_give_an_image_or_an_image_error(
    size: int, encoding: str, height: int, width: int, step: int
) -> None:
    try:
        image = decode(bytes(size), encoding=encoding, height=height, width=width, step=step)
    except ImageError:
        return
    assert image.size_hw == (height, width)
    assert image.pixels.max() < 255  # reads every pixel
