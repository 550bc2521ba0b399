"""The most expensive compressed images that are accepted."""

from __future__ import annotations

import time
from array import array
from contextlib import closing
from pathlib import Path

import cv2
import numpy as np
from sensor_msgs.msg import CompressedImage
from support import jpeg_builder, png_builder
from support.detector_process import SCENE

from soak.finding import Finding
from soak.subject import Sender, Subject
from yolov5_lifecycle.images.compressed import MAX_SCANNED_PX, MAX_SCANS, encode_jpeg
from yolov5_lifecycle.images.image import ColourImage

LARGEST_SIDE_PX = 8192
_MB_PER_MPX = 13  # coefficients of four components, the image and a copy of it
_SPARE_MB = 150
_LIMIT_S = 30.0
_ANSWER_S = 1.0
_TEXTS = 900
_TILES = 5


def bounded_decoding(subject: Subject, side_px: int, *, is_timed: bool = True) -> Finding:
    """Detect in one image of each kind, with `side_px` on each side, while the node is asked for its state.

    Times and memory are only judged if `is_timed`.
    """
    subject.reset()
    assert subject.node.set_parameters(image_transport="compressed") == ""
    subject.bring_to("active")
    with closing(Sender(subject, "compressed")) as sender:
        sender.wait_until_reliable()
        sender.send_whole()
        before_mb, files = _peak_mb(subject), _largest_files(side_px)
        times_s = [_detect(subject, sender, data) for data in files]
        grown_mb = _peak_mb(subject) - before_mb
    subject.reset()
    limit_mb = _MB_PER_MPX * side_px**2 / 1e6 + _SPARE_MB
    longest_s, answer_s = (max(column) for column in zip(*times_s, strict=True))
    is_bounded = grown_mb < limit_mb and longest_s < _LIMIT_S and answer_s < _ANSWER_S
    return Finding(
        claim="the costliest images that are accepted are detected in bounded memory and time",
        done=f"{len(files)} kinds of {side_px} x {side_px}",
        result=f"peak memory +{grown_mb:.0f} MB; {longest_s:.1f} s for one; get_state {answer_s:.2f} s",
        limit=f"{limit_mb:.0f} MB; {_LIMIT_S:g} s; {_ANSWER_S:g} s" if is_timed else "detected",
        is_met=not subject.escaped and (is_bounded or not is_timed),
    )


def _largest_files(side_px: int) -> list[bytes]:
    scans = min(MAX_SCANS, MAX_SCANNED_PX // side_px**2)
    return [
        jpeg_builder.image(side_px, side_px),
        jpeg_builder.image(side_px, side_px, components=4),
        jpeg_builder.image(side_px, side_px, components=4, marker=jpeg_builder.PROGRESSIVE),
        jpeg_builder.progressive(side_px, side_px, scans=scans),
        png_builder.image(side_px, side_px),
        png_builder.image(64, 64, before=png_builder.text_bomb(_TEXTS)),
        _tiled_scene(side_px - 1),
    ]


def _tiled_scene(side_px: int) -> bytes:
    """A JPEG that shows the scene in _TILES rows and columns, with a side that is no multiple of a block."""
    tile = cv2.resize(SCENE.frame(3)[0], (side_px // _TILES,) * 2)
    rest_px = side_px - _TILES * len(tile)
    pixels = np.pad(np.tile(tile, (_TILES, _TILES, 1)), ((0, rest_px), (0, rest_px), (0, 0)), mode="edge")
    return encode_jpeg(ColourImage(pixels, "rgb")).tobytes()


def _detect(subject: Subject, sender: Sender, data: bytes) -> tuple[float, float]:
    """Send the file until it is detected; seconds that this and the slowest answer meanwhile took."""
    detected, begun_s, answer_s = int(subject.status()["frames detected"]), time.monotonic(), 0.0
    sender.send(CompressedImage(format="jpeg", data=array("B", data)))

    def is_detected() -> bool:
        nonlocal answer_s
        asked_s = time.monotonic()
        assert subject.node.state() == "active"
        answer_s = max(answer_s, time.monotonic() - asked_s)
        return int(subject.status()["frames detected"]) > detected

    subject.observer.wait_for(is_detected, f"its detection, after {detected} others")
    return time.monotonic() - begun_s, answer_s


def _peak_mb(subject: Subject) -> float:
    lines = Path(f"/proc/{subject.process.process_id}/status").read_text().splitlines()
    (kilobytes,) = (line.split()[1] for line in lines if line.startswith("VmHWM:"))
    return int(kilobytes) / 1024
