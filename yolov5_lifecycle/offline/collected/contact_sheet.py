"""All collected images on one page, which needs neither a server nor other files."""

from __future__ import annotations

import base64
import html
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np

from yolov5_lifecycle.collecting.candidate import Trigger
from yolov5_lifecycle.collecting.collected_files import (
    MAX_IMAGE_BYTES,
    CollectedFrame,
    KeptImage,
    read_record,
    with_names,
)
from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.detection.draw import annotate
from yolov5_lifecycle.images.compressed import decode_image_file, encode_jpeg
from yolov5_lifecycle.images.image import ColourImage
from yolov5_lifecycle.input_file import read_regular_file
from yolov5_lifecycle.printable import in_one_line

THUMBNAIL_PX = 320
"""Longer side of an image on the page."""
_QUALITY = 70
_TRIGGERS = [trigger.value for trigger in Trigger]
_OTHER = "other"
_PAGE = """<!DOCTYPE html>
<html lang="en"><meta charset="utf-8"><meta name="viewport" content="width=device-width">
<title>{title}</title>
<style>
body {{ font: 14px system-ui, sans-serif; margin: 1em; color-scheme: light dark }}
section {{ display: grid; grid-template-columns: repeat(auto-fill, minmax(260px, 1fr)); gap: 1em }}
figure {{ margin: 0; overflow-wrap: anywhere }} img {{ width: 100% }}
</style>
<h1>{title}</h1>
"""


def contact_sheet(
    folder: Path, images: Iterable[tuple[KeptImage, str]], class_names: Sequence[str], *, title: str
) -> Iterator[str]:
    """The page in parts: `images` by the reason with each, see `first_reason`, in their order.

    What the model found is drawn in them; `class_names` decide on the colours. An image that cannot be read
    is told in its place.
    """
    yield _PAGE.format(title=html.escape(in_one_line(title)))
    by_reason = defaultdict[str, list[str]](list)
    for kept, reason in images:
        by_reason[reason].append(kept.path)
    for reason in filter(by_reason.get, (*_TRIGGERS, _OTHER)):
        yield f"<h2>{reason}: {len(by_reason[reason])}</h2>\n<section>\n"
        for path in by_reason[reason]:
            yield _figure(folder, path, class_names)
        yield "</section>\n"
    yield "</html>\n"


def first_reason(frame: CollectedFrame) -> str:
    """The most valuable reason that this version knows, or `other`."""
    return next((name for name in _TRIGGERS if name in frame.reasons), _OTHER)


def _figure(folder: Path, path: str, class_names: Sequence[str]) -> str:
    told = path
    try:
        frame = read_record(folder, path)
        told += " " + "; ".join(f"{name}: {text}" for name, text in frame.reasons.items())
        jpeg = base64.b64encode(_thumbnail(folder, frame, class_names)).decode()
        picture = f'<img loading="lazy" alt="" src="data:image/jpeg;base64,{jpeg}">'
    except (ValueError, OSError) as error:
        picture = f"<p>{html.escape(in_one_line(str(error)))}</p>"
    return f"<figure>{picture}<figcaption>{html.escape(in_one_line(told))}</figcaption></figure>\n"


def _thumbnail(folder: Path, frame: CollectedFrame, class_names: Sequence[str]) -> bytes:
    """A small JPEG file of the image with the objects that the model found."""
    data = np.frombuffer(read_regular_file(folder / frame.image, MAX_IMAGE_BYTES), np.uint8)
    image = decode_image_file(data)
    height, width = image.size_hw
    scale = min(THUMBNAIL_PX / max(height, width), 1.0)
    size_wh = max(round(width * scale), 1), max(round(height * scale), 1)
    pixels = np.asarray(cv2.resize(image.pixels, size_wh, interpolation=cv2.INTER_AREA), np.uint8)
    names = with_names(class_names, [found.class_name for found in frame.objects])
    drawn = annotate(ColourImage(pixels, image.order), _detections(frame, names, scale), names)
    return encode_jpeg(ColourImage(drawn, image.order), quality=_QUALITY).tobytes()


def _detections(frame: CollectedFrame, names: Sequence[str], scale: float) -> Detections:
    """The objects of `frame`, whose boxes may come from anywhere, in an image that is `scale` as large."""
    class_ids = {name: index for index, name in enumerate(names)}
    found = sorted(frame.objects, key=lambda one: -one.score)
    corners = np.array([one.box_xyxy for one in found], np.float64).reshape(-1, 2, 2)
    corners = np.sort(np.clip(corners, -1e6, 1e6), axis=1) * scale
    return Detections(
        corners.reshape(-1, 4).astype(np.float32),
        np.array([one.score for one in found], np.float32),
        np.array([class_ids[one.class_name] for one in found], np.int64),
        track_ids=tuple(one.track_id for one in found),
    )
