"""Compressed images that are damaged, hostile or too large are refused before they cost anything."""

from __future__ import annotations

import os
import zlib
from collections.abc import Callable

import cv2
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from support import jpeg_builder as jpeg
from support import png_builder
from support.colcon_workspace import SUPPORT_PATH
from support.compressed_files import smooth_file
from support.hostile_images import FOREIGN_FILES, HOSTILE_JPEGS, HOSTILE_PNGS
from support.started import printed_by

from benchmark.process_memory import forget_peak, peak_resident_mb, resident_mb
from yolov5_lifecycle.images.compressed import (
    MAX_SCANNED_PX,
    MAX_SCANS,
    MAX_SEGMENTS,
    decode_compressed,
    decode_image_file,
    jpeg_structure,
    png_structure,
)
from yolov5_lifecycle.images.image import ColourImage, ImageError


def test_a_jpeg_may_have_fill_bytes_and_a_table_before_its_frame_header() -> None:
    data = smooth_file(".jpg")
    table = b"\xff\xc4" + (19).to_bytes(2, "big") + b"\x03" + bytes(16)  # an empty Huffman table
    assert decode_compressed(data[:2] + table + b"\xff" * 2000 + data[2:]).size_hw == (40, 60)


HOSTILE_IN_MESSAGES = {
    **{f"JPEG, {name}": each for name, each in HOSTILE_JPEGS.items()},
    **{f"PNG, {name}": each for name, each in HOSTILE_PNGS.items()},
}
HOSTILE_FILES = {
    name: (start.ljust(100, b"\0"), f"begin with {start[:4].hex()}.*Convert it to PNG")
    for name, start in FOREIGN_FILES.items()
}


def test_a_jpeg_at_every_limit_is_decoded() -> None:
    assert decode_compressed(jpeg.progressive(48, 64, scans=MAX_SCANS)).size_hw == (48, 64)
    most_scanned = np.frombuffer(jpeg.progressive(4096, 4096, MAX_SCANNED_PX >> 24), np.uint8)
    assert jpeg_structure(most_scanned).size_hw == (4096, 4096)
    texts = jpeg.segment(0xE1, b"") * (MAX_SEGMENTS - 7)
    assert decode_compressed(jpeg.opened(texts, jpeg.frame(8, 8)) + jpeg.closed()).size_hw == (8, 8)


@pytest.mark.parametrize(
    "tail",
    [
        pytest.param(jpeg.SOI + jpeg.progressive(8, 8, 99) * 20, id="more images"),
        pytest.param(b"\0\0\0\x20ftypmp42" + np.random.default_rng(0).bytes(1 << 20), id="a video"),
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


BOMB = png_builder.chunk(b"zTXt", b"k\0\0" + zlib.compress(bytes(1_000_000)))
"""A compressed text, a thousandth of the size that it has for libpng."""
TEXTS = BOMB * 3 + png_builder.chunk(b"iCCP", b"x\0\0" + bytes(9))


@pytest.mark.parametrize(
    "chunks",
    [
        pytest.param({"before": TEXTS}, id="compressed texts and a profile"),
        pytest.param({"after": TEXTS}, id="compressed texts and a profile after the pixels"),
        pytest.param({"before": png_builder.header(4096, 4096)}, id="header"),
        pytest.param({"before": png_builder.chunk(b"CgBI", bytes(4))}, id="critical chunk of another format"),
    ],
)
def test_chunks_that_a_png_does_not_need_are_not_decoded(chunks: dict[str, bytes]) -> None:
    data = np.frombuffer(png_builder.image(8, 9, **chunks) + bytes(20), np.uint8)
    assert png_structure(data).data.tobytes() == png_builder.image(8, 9)
    assert decode_compressed(data).size_hw == (8, 9)


def test_a_plain_png_is_not_copied() -> None:
    data = np.frombuffer(png_builder.image(8, 9) + bytes(20), np.uint8)
    alone = png_structure(data).data
    assert np.shares_memory(alone, data)
    assert alone.size == data.size - 20


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
        size_hw = jpeg_structure(data).size_hw
    except ImageError:
        return
    pixels = cv2.imdecode(data, cv2.IMREAD_COLOR)
    assert pixels is None or pixels.shape[:2] == size_hw


@pytest.mark.long
@pytest.mark.parametrize(
    ("make", "bytes_per_pixel"),
    [
        pytest.param(lambda side: jpeg.progressive(side, side, MAX_SCANNED_PX // side**2), 6, id="scans"),
        pytest.param(
            lambda side: jpeg.image(side, side, components=4, marker=jpeg.PROGRESSIVE), 11, id="coefficients"
        ),
        pytest.param(lambda side: png_builder.image(side, side), 6, id="png"),
    ],
)
def test_the_costliest_images_that_are_accepted_are_decoded_in_bounded_memory(
    make: Callable[[int], bytes], bytes_per_pixel: int
) -> None:
    """The image and one copy of it; or the image and the coefficients of four components."""
    side = 8192
    data = np.frombuffer(make(side), np.uint8)
    before_mb = resident_mb(os.getpid())
    forget_peak()
    assert decode_compressed(data).size_hw == (side, side)
    assert peak_resident_mb(os.getpid()) - before_mb < bytes_per_pixel * side**2 / 2**20 + 100


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


def test_opencv_itself_refuses_larger_images_in_our_processes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("OPENCV_IO_MAX_IMAGE_PIXELS", raising=False)
    assert printed_by(LIMITED, variables=SUPPORT_PATH) == "refused\n"


@pytest.mark.parametrize("suffix", [".webp", ".bmp"])
def test_a_file_of_another_usual_format_is_decoded(suffix: str) -> None:
    assert decode_image_file(np.frombuffer(smooth_file(suffix), np.uint8)).size_hw == (40, 60)


@pytest.mark.parametrize("decode", [decode_compressed, decode_image_file])
@pytest.mark.parametrize(("data", "reason"), HOSTILE_IN_MESSAGES.values(), ids=HOSTILE_IN_MESSAGES)
def test_a_hostile_jpeg_or_png_is_refused_before_it_is_decoded(
    data: bytes,
    reason: str,
    decode: Callable[[NDArray[np.uint8]], ColourImage],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delattr(cv2, "imdecode")
    with pytest.raises(ImageError, match=reason):
        decode(np.frombuffer(data, np.uint8))


@pytest.mark.parametrize(("data", "reason"), HOSTILE_FILES.values(), ids=HOSTILE_FILES)
def test_a_hostile_file_is_refused_before_it_is_decoded(
    data: bytes, reason: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delattr(cv2, "imdecode")
    with pytest.raises(ImageError, match=reason):
        decode_image_file(np.frombuffer(data, np.uint8))
