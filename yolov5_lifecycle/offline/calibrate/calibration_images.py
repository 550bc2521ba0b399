"""The images that a model is calibrated on: diverse, as the network receives them."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.detection.letterbox import Letterbox
from yolov5_lifecycle.images.image import ColourImage, ImageError
from yolov5_lifecycle.offline.detecting import StoredImage
from yolov5_lifecycle.offline.image_files import VideoFile, has_still_images, image_files
from yolov5_lifecycle.offline.recordings import is_recording
from yolov5_lifecycle.sources.frames import SourceError

_THUMBNAIL_WH = (16, 12)
_CANDIDATES_PER_IMAGE = 2
_ENOUGH_TO_SPLIT = 20

Item = TypeVar("Item")
Fit = Callable[[ColourImage], ColourImage]
Lost = Callable[[str, ImageError], None]


def read_calibration_images(
    path: Path, topic: str | None, count: int, fit: Fit, *, lost: Lost, seen: Callable[[int], None]
) -> list[ColourImage]:
    """At most `count` images of `path`, in one size: see `diverse_images`.

    Raises SourceError, RecordingError (both ValueErrors) and ImportError without rosbags.
    """
    with _opened(path, topic) as (images, claimed):
        chosen = diverse_images(images, claimed, count, fit, lost=lost, seen=seen)
    if not chosen:
        raise SourceError(f"{path}: none of its images can be used")
    return of_one_size(chosen)


@contextmanager
def _opened(path: Path, topic: str | None) -> Iterator[tuple[Iterable[StoredImage], int]]:
    """The images of a recording, a video or a folder, and how many it claims to have, 0 if unknown."""
    if is_recording(path):
        from yolov5_lifecycle.offline.recording import open_recording  # its package is optional

        with open_recording(path) as recording:
            found = recording.image_topic(topic)
            yield recording.messages(found), found.count
        return
    if topic is not None:
        raise SourceError(f"--topic does not apply to {path}, which is no recording")
    is_folder = all((path / name).is_dir() for name in ("images", "labels"))
    if is_folder or path.suffix.lower() in (".json", ".yaml", ".yml"):
        raise SourceError(f"{path}: expected images; of a data set, give the folder of its images")
    if has_still_images(path):
        files = image_files(path)
        yield files, len(files)
    else:
        video = VideoFile.open(path)
        yield video.frames, video.claimed_frames


def halves(items: Sequence[Item]) -> tuple[Sequence[Item], Sequence[Item]]:
    """Images for the ranges, and images to compare with fp32; fewer than 20 are all used for both."""
    return (items[::2], items[1::2]) if len(items) >= _ENOUGH_TO_SPLIT else (items, items)


def diverse_images(
    images: Iterable[StoredImage],
    claimed: int,
    count: int,
    fit: Fit,
    *,
    lost: Lost,
    seen: Callable[[int], None],
) -> list[ColourImage]:
    """At most `count` of the `images`, spread over them, which differ from each other as much as possible.

    There are as many as `claimed`, 0 if unknown. `fit` resizes them as needed. Images that cannot be read are
    reported to `lost`; `seen` is called with the number of candidates so far.
    """
    candidates: list[ColourImage] = []
    limit = _CANDIDATES_PER_IMAGE * count
    stride = max(1, math.ceil(claimed / limit))
    for number, stored in enumerate(images):
        if len(candidates) >= limit:
            del candidates[1::2]
            stride *= 2
        if number % stride == 0:
            try:
                candidates.append(fit(stored.load()))
            except ImageError as error:
                lost(stored.label, error)
            else:
                seen(len(candidates))
    thumbnails = [
        cv2.resize(image.pixels, _THUMBNAIL_WH, interpolation=cv2.INTER_AREA).ravel() for image in candidates
    ]
    return [candidates[index] for index in farthest(np.array(thumbnails, np.float32), count)]


def farthest(thumbnails: NDArray[np.floating], count: int) -> list[int]:
    """Ascending indices of `count` rows: the first one, then always the one farthest from all chosen."""
    chosen: list[int] = []
    distances = np.full(len(thumbnails), np.inf)
    while len(chosen) < min(count, len(thumbnails)):
        distances[chosen] = -1
        chosen.append(int(distances.argmax()))
        distances = np.minimum(distances, ((thumbnails - thumbnails[chosen[-1]]) ** 2).sum(axis=1))
    return sorted(chosen)


def fitted(image: ColourImage, *, image_size: int, stride: int) -> ColourImage:
    """`image` as the network receives it."""
    letterbox = Letterbox.fit(image.size_hw, image_size=image_size, stride=stride)
    return ColourImage(letterbox.apply(image.pixels), image.channel_order)


def of_one_size(images: Sequence[ColourImage]) -> list[ColourImage]:
    """The images, at least one, in the size that most have; others fit into it, with grey bands."""
    ((size_hw, _),) = Counter(image.size_hw for image in images).most_common(1)
    return [
        ColourImage(Letterbox.into(image.size_hw, size_hw).apply(image.pixels), image.channel_order)
        for image in images
    ]
