"""Property: whatever is sent as an image becomes an image of the size that it claims, or an ImageError."""

from __future__ import annotations

import functools

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from support.compressed_files import KINDS, compressed

from fuzz.targets import check_compressed_image
from yolov5_lifecycle.images.compressed import decode_compressed
from yolov5_lifecycle.images.encodings import decode_raw
from yolov5_lifecycle.images.image import ImageError

_PLACE = st.floats(0, 1, exclude_max=True)


@pytest.mark.parametrize("kind", KINDS)
def test_the_whole_files_are_decoded(kind: str) -> None:
    assert decode_compressed(compressed(kind)).size_hw == (9, 12)


@settings(max_examples=60)
@given(st.sampled_from(KINDS), st.lists(st.tuples(_PLACE, st.integers(0, 7)), min_size=1, max_size=20))
def test_a_file_with_flipped_bits_is_an_image_or_refused(kind: str, flips: list[tuple[float, int]]) -> None:
    data = bytearray(compressed(kind))
    for place, bit in flips:
        data[int(place * len(data))] ^= 1 << bit
    check_compressed_image(bytes(data))


@settings(max_examples=60)
@given(st.sampled_from(KINDS), st.sampled_from(KINDS), _PLACE, _PLACE)
@example("colour.png", "colour.png", 0.0, 0.99)
def test_parts_of_two_files_are_an_image_or_refused(
    first: str, second: str, until: float, since: float
) -> None:
    head, tail = compressed(first), compressed(second)
    check_compressed_image(head[: int(until * len(head))] + tail[int(since * len(tail)) :])


@given(st.sampled_from([b"", b"\xff\xd8", b"\xff\xd8\xff\xc0", b"\x89PNG\r\n\x1a\n"]), st.binary(max_size=64))
def test_any_bytes_behind_a_signature_are_an_image_or_refused(start: bytes, rest: bytes) -> None:
    check_compressed_image(start + rest)


@settings(max_examples=50)
@given(
    size_hw=st.tuples(st.integers(1, 5), st.integers(1, 5)),
    padding=st.integers(0, 3),
    missing=st.integers(0, 2),
    data=st.data(),
)
def test_a_raw_buffer_gives_its_own_pixels_or_is_refused(
    size_hw: tuple[int, int], padding: int, missing: int, data: st.DataObject
) -> None:
    height, width = size_hw
    step = 3 * width + padding
    size = step * (height - 1) + 3 * width - missing
    buffer = data.draw(st.binary(min_size=size, max_size=size))
    decode = functools.partial(
        decode_raw, encoding="rgb8", height=height, width=width, step=step, is_bigendian=False
    )
    if missing:
        with pytest.raises(ImageError, match=f"found {size}"):
            decode(buffer)
        return
    pixels = decode(buffer).pixels
    for row, column in np.ndindex(height, width):
        start = row * step + 3 * column
        assert pixels[row, column].tobytes() == buffer[start : start + 3]
