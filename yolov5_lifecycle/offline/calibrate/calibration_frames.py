"""Diverse frames of a recording, a video or a folder, letterboxed for a network."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.detection.letterbox import PADDING_VALUE, Letterbox
from yolov5_lifecycle.images.image import ColourImage, ImageError
from yolov5_lifecycle.offline.detecting import StoredImage
from yolov5_lifecycle.offline.image_files import VideoFile, has_still_images, image_files

_THUMBNAIL_WH = (16, 12)
_CANDIDATES_PER_IMAGE = 2
_ENOUGH_TO_SPLIT = 20

Item = TypeVar("Item")


@dataclass(frozen=True)
class Source:
    """The images of a recording, a video or a folder, and how many it claims to have, 0 if unknown."""

    images: Iterable[StoredImage]
    claimed: int


@dataclass(frozen=True, eq=False)
class ChosenImage:
    """An image and its number in the source, from 0."""

    number: int
    image: ColourImage


def open_files(path: Path) -> Source:
    """The image `path`, the images in the folder `path`, or the video `path`; raises SourceError."""
    if has_still_images(path):
        files = image_files(path)
        return Source(files, len(files))
    video = VideoFile.open(path)
    return Source(video.frames, video.claimed_frames)


@contextmanager
def open_bag(path: Path, topic: str | None) -> Iterator[Source]:
    """The images of a topic of a recording; raises RecordingError, and ImportError without rosbags."""
    from yolov5_lifecycle.offline.recording import open_recording  # its package is optional

    with open_recording(path) as recording:
        image_topic = recording.image_topic(topic)
        yield Source(recording.images(image_topic), image_topic.count)


def diverse_images(
    source: Source,
    count: int,
    fit: Callable[[ColourImage], ColourImage],
    *,
    lost: Callable[[str, ImageError], None],
    seen: Callable[[int], None],
) -> list[ChosenImage]:
    """At most `count` images, spread over the source, which differ from each other as much as possible.

    `fit` resizes them as needed. Images that cannot be read are reported to `lost`; `seen` is called with the
    number of candidates so far.
    """
    candidates: list[ChosenImage] = []
    for number, image in _spread(source, _CANDIDATES_PER_IMAGE * count, candidates, lost):
        candidates.append(ChosenImage(number, fit(image)))
        seen(len(candidates))
    thumbnails = np.array([_thumbnail(each.image) for each in candidates])
    return [candidates[index] for index in farthest(thumbnails, count)]


def _spread(
    source: Source, limit: int, candidates: list[ChosenImage], lost: Callable[[str, ImageError], None]
) -> Iterator[tuple[int, ColourImage]]:
    """Every n-th image and its number.

    When there are `limit` candidates, every other one is dropped and n doubled.
    """
    stride = max(1, math.ceil(source.claimed / limit))
    for number, stored in enumerate(source.images):
        if len(candidates) >= limit:
            del candidates[1::2]
            stride *= 2
        if number % stride == 0:
            try:
                image = stored.load()
            except ImageError as error:
                lost(stored.label, error)
            else:
                yield number, image


def halves(items: Sequence[Item]) -> tuple[Sequence[Item], Sequence[Item]]:
    """Images for the ranges, and images to compare with fp32; fewer than 20 are all used for both."""
    return (items[::2], items[1::2]) if len(items) >= _ENOUGH_TO_SPLIT else (items, items)


def farthest(thumbnails: NDArray[np.floating], count: int) -> list[int]:
    """Ascending indices of `count` rows: the first one, then always the one farthest from all chosen."""
    if not len(thumbnails):
        return []
    chosen = [0]
    distances = ((thumbnails - thumbnails[0]) ** 2).sum(axis=1)
    while len(chosen) < min(count, len(thumbnails)):
        distances[chosen] = -1
        chosen.append(int(distances.argmax()))
        distances = np.minimum(distances, ((thumbnails - thumbnails[chosen[-1]]) ** 2).sum(axis=1))
    return sorted(chosen)


def _thumbnail(image: ColourImage) -> NDArray[np.float32]:
    small = cv2.resize(image.pixels, _THUMBNAIL_WH, interpolation=cv2.INTER_AREA)
    return np.asarray(small, np.float32).ravel()


def fitted(image: ColourImage, *, image_size: int, stride: int) -> ColourImage:
    """`image` as the network receives it."""
    letterbox = Letterbox.fit(image.size_hw, image_size=image_size, stride=stride)
    return ColourImage(letterbox.apply(image.pixels), image.order)


def of_one_size(images: Sequence[ColourImage]) -> list[ColourImage]:
    """The images in the size that most have; others are scaled to fit into it, with grey bands."""
    if not images:
        return []
    (size_hw, _), *_ = Counter(image.size_hw for image in images).most_common()
    return [image if image.size_hw == size_hw else _placed(image, size_hw) for image in images]


def _placed(image: ColourImage, size_hw: tuple[int, int]) -> ColourImage:
    height, width = image.size_hw
    scale = min(size_hw[0] / height, size_hw[1] / width)
    inner_hw = (max(round(height * scale), 1), max(round(width * scale), 1))
    canvas = np.full((*size_hw, 3), PADDING_VALUE, np.uint8)
    top, left = ((whole - inner) // 2 for whole, inner in zip(size_hw, inner_hw, strict=True))
    inner = canvas[top : top + inner_hw[0], left : left + inner_hw[1]]
    inner[:] = cv2.resize(image.pixels, inner_hw[::-1], interpolation=cv2.INTER_LINEAR)
    return ColourImage(canvas, image.order)
