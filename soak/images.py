"""Invalid images, as a camera, a network or an attacker may send, and what becomes of them."""

from __future__ import annotations

import struct
import zlib
from array import array
from collections import Counter
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from random import Random

import cv2
import numpy as np
from rclpy.serialization import serialize_message
from sensor_msgs.msg import CompressedImage, Image
from support.hostile_images import HOSTILE_JPEGS, HOSTILE_PNGS

from soak.finding import Finding, number_of
from soak.service_requests import Fuzz
from soak.subject import Sender, Subject
from yolov5_lifecycle.images.encodings import ENCODINGS
from yolov5_lifecycle.images.image import MAX_FRAME_ID, MAX_SIDE_PX

_COSTLY = [*HOSTILE_JPEGS.values(), *HOSTILE_PNGS.values()]
_UNKNOWN = ("", "RGB8", "rgb8 ", "bayer_rggb16", "yuv444", "32FC1", "32FC3", "x" * 100_000)
_NUMBERS = (0, 1, 2, 7, 48, 64, 640, MAX_SIDE_PX, MAX_SIDE_PX + 1, 2**31 - 1, 2**31, 2**32 - 1)
_SIZES = (0, 1, 7, 191, 48 * 64, 48 * 64 * 3, 48 * 64 * 4, 1_000_000)
_LONG_FRAME_ID_ODDS = 0.02
_LONG_FRAME_IDS = (MAX_FRAME_ID + 1, 100_000, 16_000_000)
MakeImage = Callable[[Fuzz], Image | CompressedImage | bytes]
"""Creates a message, or the bytes of one."""
_ODD_SIZES_HW = ((1, 1), (1, MAX_SIDE_PX), (MAX_SIDE_PX, 1), (2, 3), (3, 4001), (1999, 5))
_PNG_START = b"\x89PNG\r\n\x1a\n"
_BATCH = 250
_FOREIGN = (b"GIF89a", b"BM", b"II*\0", b"RIFF\0\0\0\0WEBPVP8 ", b"\0\0\0\x0cjP  ", b"%PDF-1.7", b"\x80\x04.")


def hostile_image(fuzz: Fuzz) -> Image:
    """A raw image with random fields that make it unreadable, or with a frame_id that is too long."""
    if fuzz.random.random() < _LONG_FRAME_ID_ODDS:
        return _with_long_frame_id(fuzz)
    while True:
        choose = fuzz.random.choice
        message = Image(
            height=choose(_NUMBERS),
            width=choose(_NUMBERS),
            step=choose((*_NUMBERS, 192)),
            encoding=choose((*ENCODINGS, *_UNKNOWN)),
        )
        fuzz.fill(message.header)
        message.is_bigendian = fuzz.random.randrange(256)
        message.data = array("B", bytes(choose(_SIZES)))
        if not _is_readable(message):
            return message


def odd_image(fuzz: Fuzz) -> Image:
    """A readable raw image with a shape and header that no camera sends."""
    height, width = fuzz.random.choice(_ODD_SIZES_HW)
    message = Image(height=height, width=width, step=3 * width, encoding="bgr8")
    fuzz.fill(message.header)
    message.header.frame_id = message.header.frame_id[:MAX_FRAME_ID]
    message.data = array("B", fuzz.random.randbytes(3 * width) * height)
    return message


def _with_long_frame_id(fuzz: Fuzz) -> Image:
    """A readable raw image, but for its frame_id."""
    message = odd_image(fuzz)
    message.header.frame_id = "x" * fuzz.random.choice(_LONG_FRAME_IDS)
    return message


def hostile_file(fuzz: Fuzz) -> CompressedImage:
    """A compressed image that is cut before its pixels, of another format, too large, or hides its cost."""
    makers = [_cut_png, _beheaded_jpeg, _png_bomb, _jpeg_bomb, _noise, _foreign, _costly]
    return _message(fuzz, fuzz.random.choice(makers)(fuzz.random))


def damaged_file(fuzz: Fuzz) -> CompressedImage:
    """A compressed image with wrong or missing bytes; some of its pixels may still be readable."""
    return _message(fuzz, _damaged(fuzz.random, _file(fuzz.random.choice([".jpg", ".png"]))))


def damaged_message(fuzz: Fuzz) -> bytes:
    """A small serialized raw image with wrong or missing bytes."""
    side, (encoding, layout) = 8, fuzz.random.choice([*ENCODINGS.items()])
    step = side * layout.pixel_bytes
    message = Image(height=side, width=side, step=step, encoding=encoding)
    message.data = array("B", bytes(int(side * layout.rows) * step))
    return _damaged(fuzz.random, serialize_message(message))


def _is_readable(image: Image) -> bool:
    """Whether `image` follows sensor_msgs/Image, the last row with or without its padding."""
    if len(image.header.frame_id) > MAX_FRAME_ID:
        return False
    size_hw = image.height, image.width
    if image.encoding not in ENCODINGS or not 0 < min(size_hw) <= max(size_hw) <= MAX_SIDE_PX:
        return False
    layout = ENCODINGS[image.encoding]
    is_whole = all(side % block == 0 for side, block in zip(size_hw, layout.block_hw, strict=True))
    row, rows = image.width * layout.pixel_bytes, image.height * layout.rows
    is_held = image.step >= row and len(image.data) >= image.step * (rows - 1) + row
    return bool(is_whole and is_held and min(size_hw) >= layout.min_side_px)


def _damaged(random: Random, whole: bytes) -> bytes:
    data = bytearray(whole)
    for _ in range(random.randint(1, 20)):
        data[random.randrange(len(data))] = random.randrange(256)
    return bytes(data[: random.choice([len(data), random.randrange(len(data))])])


def _message(fuzz: Fuzz, data: bytes) -> CompressedImage:
    message = CompressedImage(format=fuzz.random.choice(["jpeg", "png", "", "rgb8; jpeg compressed bgr8"]))
    fuzz.fill(message.header)
    message.data = array("B", data)
    return message


def _file(extension: str) -> bytes:
    pixels = np.arange(48 * 64 * 3, dtype=np.uint8).reshape(48, 64, 3)
    return bytes(cv2.imencode(extension, pixels)[1])


def _cut_png(random: Random) -> bytes:
    data = _file(".png")
    return data[: random.randrange(len(data))]


def _beheaded_jpeg(random: Random) -> bytes:
    """A JPEG truncated before the frame header, which has the size."""
    data = _file(".jpg")
    return data[: random.randrange(data.index(b"\xff\xc0") + 9)]


def _png_bomb(random: Random) -> bytes:
    """A complete PNG of a few bytes that claims a huge image."""
    return _png(
        *random.choice([(2**31 - 1, 2**31 - 1), (MAX_SIDE_PX, MAX_SIDE_PX), (1, MAX_SIDE_PX + 1), (0, 1)])
    )


def _jpeg_bomb(random: Random) -> bytes:
    data = bytearray(_file(".jpg"))
    sides = random.choice([(65535, 65535), (MAX_SIDE_PX, MAX_SIDE_PX), (1, 65535), (0, 64)])
    struct.pack_into(">HH", data, data.index(b"\xff\xc0") + 5, *sides)
    return bytes(data)


def _costly(random: Random) -> bytes:
    return random.choice(_COSTLY)[0]


def _noise(random: Random) -> bytes:
    start = random.choice([b"", b"\xff\xd8", b"\xff\xd8\xff", _PNG_START])
    return start + random.randbytes(random.choice([0, 1, 8, 40]))


def _foreign(random: Random) -> bytes:
    return random.choice(_FOREIGN) + bytes(random.randrange(200))


def _png(height: int, width: int) -> bytes:
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    chunks = {b"IHDR": header, b"IDAT": zlib.compress(bytes(10_000)), b"IEND": b""}
    return _PNG_START + b"".join(_chunk(name, data) for name, data in chunks.items())


def _chunk(name: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))


def rejected(transport: str, subject: Subject, count: int, seed: int) -> Finding:
    """Send images with invalid fields, or invalid files; all must be rejected."""
    make: MakeImage = hostile_image if transport == "raw" else hostile_file
    fates = _fates(transport, make, subject, count, seed)
    are_rejected = fates.counts.keys() <= {"rejected", "detected", "stale", "lost", "overtaken"}
    return Finding(
        claim=f"every hostile {transport} image is rejected",
        done=f"{fates.hostile} images and {fates.whole} whole ones, seed {seed}",
        result=str(fates),
        limit="whole ones detected, others rejected, stale, overtaken or lost; 0; 0",
        is_met=are_rejected
        and fates.counts["detected"] <= fates.whole
        and not fates.unaccounted
        and not fates.escaped,
    )


def survived(transport: str, subject: Subject, count: int, seed: int) -> Finding:
    """Send files, or serialized messages, with wrong or missing bytes, which may be partly readable."""
    make: MakeImage = damaged_message if transport == "raw" else damaged_file
    fates = _fates(transport, make, subject, count, seed)
    return Finding(
        claim=f"every damaged {transport} image is survived",
        done=f"{fates.hostile} images with wrong or missing bytes, seed {seed}",
        result=str(fates),
        limit="none failed; 0; 0",
        is_met=not fates.counts["failed"] and not fates.unaccounted and not fates.escaped,
    )


@dataclass(frozen=True)
class _Fates:
    """Images sent to the subject and their outcomes."""

    hostile: int
    whole: int
    counts: Counter[str]
    escaped: list[str]

    @property
    def unaccounted(self) -> int:
        return self.hostile + self.whole - self.counts.total()

    def __str__(self) -> str:
        counts = ", ".join(f"{count} {fate}" for fate, count in self.counts.most_common())
        return f"{counts}; {self.unaccounted} unaccounted; {number_of('exceptions', self.escaped)}"


def _fates(transport: str, make: MakeImage, subject: Subject, count: int, seed: int) -> _Fates:
    """Send hostile images until `count` have an outcome, with valid ones in between."""
    subject.reset()
    assert subject.node.set_parameters(image_transport=transport) == ""
    subject.bring_to("active")
    fuzz, hostile, counts = Fuzz(seed), 0, Counter[str]()
    with closing(Sender(subject, transport)) as sender:
        sender.wait_until_reliable()
        sender.send_whole()  # from here on lost images are counted
        before, sender.whole = _counts(subject), 0
        while counts["rejected"] + counts["detected"] - sender.whole < count:
            for _ in range(_BATCH):
                sender.send(make(fuzz))
            hostile += _BATCH
            sender.send_whole()
            counts = _counts(subject) - before
    subject.reset()
    return _Fates(hostile, sender.whole, counts, subject.escaped)


def _counts(subject: Subject) -> Counter[str]:
    """Frames by outcome so far."""
    prefix = "frames "
    ends = {key.removeprefix(prefix): value for key, value in subject.status().items() if prefix in key}
    return Counter({end: int(count) for end, count in ends.items() if end != "received"})
