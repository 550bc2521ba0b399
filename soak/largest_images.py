"""The most expensive compressed images that are accepted."""

from __future__ import annotations

import time
from array import array
from contextlib import closing
from pathlib import Path

from sensor_msgs.msg import CompressedImage
from support import jpeg_builder, png_builder

from soak.finding import Finding
from soak.sender import Sender
from soak.subject import Subject
from yolov5_lifecycle.images.jpeg_structure import MAX_SCANNED_PX, MAX_SCANS

LARGEST_SIDE_PX = 8192
_MB_PER_MPX = 13  # coefficients of four components, the image and a copy of it
_SPARE_MB = 150
_LIMIT_S = 30.0
_TEXTS = 900


def bounded_decoding(subject: Subject, side_px: int, *, is_timed: bool = True) -> Finding:
    """Detect in one image of each kind, with `side_px` on each side; time and memory are only judged if
    `is_timed`."""
    subject.reset()
    assert subject.node.set_parameters(image_transport="compressed") == ""
    subject.bring_to("active")
    with closing(Sender(subject, "compressed")) as sender:
        sender.wait_until_reliable()
        sender.send_whole()
        before_mb, longest_s, files = _peak_mb(subject), 0.0, _largest_files(side_px)
        for data in files:
            longest_s = max(longest_s, _detect(subject, sender, data))
        grown_mb = _peak_mb(subject) - before_mb
    subject.reset()
    limit_mb = _MB_PER_MPX * side_px**2 / 1e6 + _SPARE_MB
    is_bounded = grown_mb < limit_mb and longest_s < _LIMIT_S
    return Finding(
        claim="the costliest images that are accepted are detected in bounded memory and time",
        done=f"{len(files)} kinds of {side_px} x {side_px}",
        result=f"peak memory +{grown_mb:.0f} MB; {longest_s:.1f} s for one",
        limit=f"{limit_mb:.0f} MB; {_LIMIT_S:g} s" if is_timed else "detected",
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
    ]


def _detect(subject: Subject, sender: Sender, data: bytes) -> float:
    """Send the file until it is detected; returns how long that took, in seconds."""
    detected, begun_s = int(subject.status()["frames detected"]), time.monotonic()
    sender.send(CompressedImage(format="jpeg", data=array("B", data)))
    try:
        subject.observer.wait_for(
            lambda: int(subject.status()["frames detected"]) > detected, "its detection"
        )
    except TimeoutError as error:
        frames = {name: value for name, value in subject.status().items() if name.startswith("frames")}
        raise TimeoutError(f"{error}, after {detected} others; {frames}") from error
    return time.monotonic() - begun_s


def _peak_mb(subject: Subject) -> float:
    lines = Path(f"/proc/{subject.process.process_id}/status").read_text().splitlines()
    (kilobytes,) = (line.split()[1] for line in lines if line.startswith("VmHWM:"))
    return int(kilobytes) / 1024
