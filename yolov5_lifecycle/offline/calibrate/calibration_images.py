"""The images that a model is calibrated on: diverse, as the network receives them, and their labels."""

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

from yolov5_lifecycle.detection.letterbox import Letterbox
from yolov5_lifecycle.evaluation.ground_truth import DataError, LabelledFolder, Problems
from yolov5_lifecycle.images.image import ColourImage, ImageError
from yolov5_lifecycle.offline.detecting import StoredImage
from yolov5_lifecycle.offline.evaluate.arguments import DataOptions
from yolov5_lifecycle.offline.evaluate.labelled_data import has_labels, kind_of, labelled_data
from yolov5_lifecycle.offline.image_files import ImageFile, VideoFile, has_still_images, image_files
from yolov5_lifecycle.offline.recordings import is_recording

_THUMBNAIL_WH = (16, 12)
_CANDIDATES_PER_IMAGE = 2
_ENOUGH_TO_SPLIT = 20

Item = TypeVar("Item")
Fit = Callable[[ColourImage], ColourImage]
Lost = Callable[[str, ImageError], None]


@dataclass(frozen=True)
class Source:
    """The images of a recording, a video or a folder, and how many it claims to have, 0 if unknown."""

    images: Iterable[StoredImage]
    claimed: int


@dataclass(frozen=True, eq=False)
class CalibrationData:
    """Images of one size, as the network receives them.

    `labelled`: the files of those that are compared with fp32, and their labels; None without labels.
    """

    images: Sequence[ColourImage]
    labelled: LabelledFolder | None


def read_calibration_data(
    path: Path,
    options: DataOptions,
    count: int,
    fit: Fit,
    *,
    problems: Problems,
    lost: Lost,
    seen: Callable[[int], None],
) -> CalibrationData:
    """At most `count` images of `path`: see `diverse_images`.

    Problems with single labels are added to `problems`. Raises SourceError, RecordingError, DataError (all
    ValueErrors) and ImportError without rosbags.
    """
    _check_options(path, options)
    with _opened(path, options, problems) as (source, data):
        chosen = diverse_images(source, count, fit, lost=lost, seen=seen)
    if not chosen:
        raise DataError(f"{path}: none of its images can be used")
    labelled = _compared(data, chosen) if data is not None else None
    return CalibrationData(of_one_size([image for _, image in chosen]), labelled)


def _check_options(path: Path, options: DataOptions) -> None:
    """Raise DataError for an option that does not apply to `path`."""
    if has_labels(path) or is_recording(path):
        kind = kind_of(path) if has_labels(path) else "recording"
        found = f"a data set of the kind {kind}"
        useless = options.useless(kind)
    else:
        found = "a folder without labels, an image or a video"
        useless = [name for name, value in vars(options).items() if value is not None]
    if useless:
        raise DataError(f"--{useless[0]} does not apply to {path}, {found}")


@contextmanager
def _opened(
    path: Path, options: DataOptions, problems: Problems
) -> Iterator[tuple[Source, LabelledFolder | None]]:
    if is_recording(path):
        from yolov5_lifecycle.offline.recording import open_recording  # its package is optional

        with open_recording(path) as recording:
            topic = recording.image_topic(options.topic)
            yield Source(recording.messages(topic), topic.count), None
    elif has_labels(path):
        data = labelled_data(path, options, problems)
        yield Source([ImageFile(each.path) for each in data.images], len(data.images)), data
    elif has_still_images(path):
        files = image_files(path)
        yield Source(files, len(files)), None
    else:
        video = VideoFile.open(path)
        yield Source(video.frames, video.claimed_frames), None


def _compared(data: LabelledFolder, chosen: Sequence[tuple[int, ColourImage]]) -> LabelledFolder:
    """The labelled files of the images that are compared.

    They are sorted by size, as a network is compiled for each and only a few are kept.
    """
    _, compared = halves(chosen)
    ordered = sorted(compared, key=lambda each: each[1].size_hw)
    return LabelledFolder(data.class_names, tuple(data.images[number] for number, _ in ordered))


def halves(items: Sequence[Item]) -> tuple[Sequence[Item], Sequence[Item]]:
    """Images for the ranges, and images to compare with fp32; fewer than 20 are all used for both."""
    return (items[::2], items[1::2]) if len(items) >= _ENOUGH_TO_SPLIT else (items, items)


def diverse_images(
    source: Source, count: int, fit: Fit, *, lost: Lost, seen: Callable[[int], None]
) -> list[tuple[int, ColourImage]]:
    """At most `count` images, spread over the source, which differ from each other as much as possible.

    With their numbers in the source, from 0. `fit` resizes them as needed. Images that cannot be read are
    reported to `lost`; `seen` is called with the number of candidates so far.
    """
    candidates: list[tuple[int, ColourImage]] = []
    for number, image in _spread(source, _CANDIDATES_PER_IMAGE * count, candidates, lost):
        candidates.append((number, fit(image)))
        seen(len(candidates))
    thumbnails = [
        cv2.resize(image.pixels, _THUMBNAIL_WH, interpolation=cv2.INTER_AREA).ravel()
        for _, image in candidates
    ]
    return [candidates[index] for index in farthest(np.array(thumbnails, np.float32), count)]


def _spread(
    source: Source, limit: int, candidates: list[tuple[int, ColourImage]], lost: Lost
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
    return ColourImage(letterbox.apply(image.pixels), image.order)


def of_one_size(images: Sequence[ColourImage]) -> list[ColourImage]:
    """The images, at least one, in the size that most have; others fit into it, with grey bands."""
    ((size_hw, _),) = Counter(image.size_hw for image in images).most_common(1)
    return [
        ColourImage(Letterbox.into(image.size_hw, size_hw).apply(image.pixels), image.order)
        for image in images
    ]
