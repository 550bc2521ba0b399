"""The data that a model is calibrated on: diverse images, and their labels, if any."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from yolov5_lifecycle.evaluation.ground_truth import DataError, Problems
from yolov5_lifecycle.images.image import ColourImage, ImageError
from yolov5_lifecycle.offline.calibrate.calibration_frames import (
    ChosenImage,
    Source,
    diverse_images,
    halves,
    of_one_size,
    open_bag,
    open_files,
)
from yolov5_lifecycle.offline.evaluate.arguments import DataOptions
from yolov5_lifecycle.offline.evaluate.evaluating import LabelledData
from yolov5_lifecycle.offline.evaluate.labelled_data import has_labels, kind_of, labelled_data
from yolov5_lifecycle.offline.recordings import is_recording


@dataclass(frozen=True, eq=False)
class CalibrationData:
    """Images of one size, as the network receives them.

    `labelled`: the files of those that are compared with fp32, and their labels; None without labels.
    """

    images: Sequence[ColourImage]
    labelled: LabelledData | None


def read_calibration_data(
    path: Path,
    options: DataOptions,
    count: int,
    fit: Callable[[ColourImage], ColourImage],
    *,
    problems: Problems,
    lost: Callable[[str, ImageError], None],
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
    return CalibrationData(of_one_size([each.image for each in chosen]), labelled)


def _check_options(path: Path, options: DataOptions) -> None:
    """Raise DataError for an option that does not apply to `path`."""
    if has_labels(path) or is_recording(path):
        found = f"a data set of the kind {kind_of(path)}"
        useless = options.useless(kind_of(path))
    else:
        found = "a folder without labels, an image or a video"
        useless = [name for name, value in vars(options).items() if value is not None]
    if useless:
        raise DataError(f"--{useless[0]} does not apply to {path}, {found}")


@contextmanager
def _opened(
    path: Path, options: DataOptions, problems: Problems
) -> Iterator[tuple[Source, LabelledData | None]]:
    if is_recording(path):
        with open_bag(path, options.topic) as source:
            yield source, None
    elif has_labels(path):
        with labelled_data(path, options, problems) as data:
            yield Source(data.images(), data.expected), data
    else:
        yield open_files(path), None


def _compared(data: LabelledData, chosen: Sequence[ChosenImage]) -> LabelledData:
    """The labelled files of the images that are compared.

    They are sorted by size, as a network is compiled for each and only a few are kept.
    """
    files = list(data.images())
    _, compared = halves(chosen)
    ordered = [files[each.number] for each in sorted(compared, key=lambda each: each.image.size_hw)]
    return LabelledData(data.kind, data.class_names, len(ordered), lambda: ordered)
