"""Detection in the images of one source, written in one of the formats, drawn, and cut out."""

from __future__ import annotations

import errno
import re
import shutil
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.atomic_file import OutputError, whole_output
from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.images.encodings import encoded
from yolov5_lifecycle.images.image import ColourImage
from yolov5_lifecycle.offline.detecting import LoadDetector, OfflineDetector, RunStatistics, StoredImage
from yolov5_lifecycle.offline.export.formats import FORMATS, YOLO, DetectedImage, Output, Write, check_stems
from yolov5_lifecycle.offline.image_files import VideoFile, has_still_images, image_files
from yolov5_lifecycle.printable import in_one_line, is_utf8

MAX_CROPS = 1_000_000
"""Files of one source: more make a folder unusable."""
MIN_FREE_BYTES = 256 << 20
"""Of the disk: what crops leave free."""
_MAX_NAME_LETTERS = 40
_LENGTH_FOLLOWS = 1
_OTHER_NAME = "choose a name that ends in .png or .jpg"
"""In place of the length of an MP4 box: 64 bits behind its name have it."""


@dataclass(frozen=True)
class Export:
    """What is written of one source, and where."""

    path: Path | None
    """New output; None for stdout."""
    suffix: str
    """Its format in FORMATS; "" stands for a recording."""
    masks: bool = True
    """Whether to write the masks of a segmentation model, if the format has some."""
    crops: Path | None = None
    """New folder for an image of each detection."""
    annotated: Path | None = None
    """New annotated images or video: a folder if the source is one, else a file."""
    topic: str | None = None
    """Of the images in a recording; None for the only one."""
    node: str = "/yolov5"
    """After which a new recording names its topics."""
    images: bool = False
    """Whether a new recording has annotated images."""

    @property
    def needs_masks(self) -> bool:
        """Whether masks are written or drawn."""
        written = self.masks and (not self.suffix or FORMATS[self.suffix].has_masks)
        return written or self.images or self.annotated is not None

    @contextmanager
    def whole(self) -> Iterator[Export]:
        """With temporary paths, which are renamed when the block succeeds, see `whole_output`."""
        with ExitStack() as stack:
            path, crops, annotated = (
                stack.enter_context(whole_output(output)) if output else None
                for output in (self.path, self.crops, self.annotated)
            )
            yield replace(self, path=path, crops=crops, annotated=annotated)


def write_files(source: Path, export: Export, load: LoadDetector) -> RunStatistics:
    """Write the detections in the images or the video `source`; what is written stays on failure.

    Raises SourceError, OutputError, DetectingError and what `load` raises.
    """
    annotated = export.annotated
    if not has_still_images(source):
        video = VideoFile.open(source)
        if annotated:
            check_video_name(annotated)
        film = partial(annotated_video, annotated, video.rate_hz) if annotated else None
        return export_images(video.frames, video.claimed_frames, export, load, film)
    files = image_files(source)
    if export.suffix == YOLO:
        check_stems(files)
    drawings = partial(annotated_images, annotated, source.is_dir()) if annotated else None
    return export_images(files, len(files), export, load, drawings)


def export_images(
    images: Iterable[StoredImage],
    expected: int,
    export: Export,
    load: LoadDetector,
    further: Callable[[OfflineDetector], Output] | None = None,
) -> RunStatistics:
    """Write the detections in `images`, of which there are `expected`, and open a `further` output first.

    Raises OutputError, OSError, DetectingError and what `load` raises; then the outputs are damaged.
    """
    detector = load()
    with ExitStack() as stack:
        outputs = [] if further is None else [stack.enter_context(further(detector))]
        if export.crops is not None:
            outputs.append(Crops(export.crops, detector.class_names).write)
        if export.suffix:
            opened = FORMATS[export.suffix].open(export.path, detector.class_names, export.masks)
            outputs.append(stack.enter_context(opened))

        def write(stored: StoredImage, image: ColourImage, detections: Detections) -> None:
            found = DetectedImage(stored, image, detections)
            for output in outputs:
                output(found)

        return detector.run(images, expected=expected, write=write)


def write_image(path: Path, drawn: ColourImage) -> None:
    """Write one image in the format given by the file extension; raises OutputError and OSError.

    cv2.imwrite would ignore that the last bytes of a file cannot be written.
    """
    name = in_one_line(path.name)
    if not is_utf8(path.suffix):  # OpenCV 5.0 crashes
        raise OutputError(f"{name}: OpenCV cannot write this image, {_OTHER_NAME}.")
    try:
        is_encoded, data = cv2.imencode(path.suffix, encoded(drawn, "bgr8"))
    except cv2.error as error:
        raise OutputError(f"{name}: OpenCV cannot write this image ({error.err}), {_OTHER_NAME}.") from None
    if not is_encoded:
        raise OutputError(f"{name}: OpenCV cannot write this image, {_OTHER_NAME}.")
    path.write_bytes(data)


def check_video_name(path: Path) -> None:
    """Raise OutputError for an unknown format, and for a path that is not UTF-8."""
    if path.suffix.lower() != ".mp4":
        raise OutputError(f"{path.name}: expected a video file name that ends in .mp4.")
    if not is_utf8(str(path)):  # OpenCV 5.0 crashes
        raise OutputError(
            f"{in_one_line(path.name)}: the path of an annotated video must be UTF-8: "
            "choose another --annotated."
        )


@contextmanager
def annotated_images(path: Path, is_folder: bool, detector: OfflineDetector) -> Iterator[Write]:
    """Images that `detector` draws, in the new folder `path`, or a single one."""
    if is_folder:
        path.mkdir()

    def write(found: DetectedImage) -> None:
        name = Path(str(found.stored.identity["file"])).name
        write_image(path / name if is_folder else path, detector.drawn(found.image, found.detections))

    yield write


@contextmanager
def annotated_video(path: Path, rate_hz: float, detector: OfflineDetector) -> Iterator[Write]:
    """A video file of `rate_hz`, whose frames `detector` draws, each resized to the size of the first.

    Raises OutputError if this OpenCV cannot write the format, and if the file lacks its end.
    """
    writer: Any = None
    size_hw = (0, 0)

    def write(found: DetectedImage) -> None:
        nonlocal writer, size_hw
        drawn = detector.drawn(found.image, found.detections)
        frame: NDArray[np.uint8] = encoded(drawn, "bgr8")
        if writer is None:
            size_hw = drawn.size_hw
            writer = _video_writer(path, rate_hz, size_hw)
        if drawn.size_hw != size_hw:  # OpenCV silently drops frames of another size
            frame = np.asarray(cv2.resize(frame, size_hw[::-1], interpolation=cv2.INTER_AREA), np.uint8)
        writer.write(np.ascontiguousarray(frame))

    try:
        yield write
    finally:
        if writer is not None:
            writer.release()
    if writer is not None and not is_whole_video(path):
        raise OutputError(f"{path.name}: the video could not be written completely; is the disk full?")


def _video_writer(path: Path, rate_hz: float, size_hw: tuple[int, int]) -> Any:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), rate_hz, size_hw[::-1])
    if not writer.isOpened():
        raise OutputError(
            f"{path.name}: OpenCV cannot write an .mp4 of {rate_hz:g} frames per second. "
            "Install opencv-python-headless, or convert the source to another rate with FFmpeg."
        )
    return writer


def is_whole_video(path: Path) -> bool:
    """Whether the boxes of the .mp4 file end where it ends, with its index; raises OSError.

    OpenCV's writer reports no error when the disk is full, and in a file without its last bytes it may find
    all frames. But the format is a sequence of boxes that begin with their length: a missing end shows.
    """
    size, end, names = path.stat().st_size, 0, set()
    with path.open("rb") as file:
        while end < size:
            file.seek(end)
            header = file.read(16)
            length = int.from_bytes(header[:4], "big")
            if length == _LENGTH_FOLLOWS:
                length = int.from_bytes(header[8:], "big")
            if length == 0:  # unknown while it was written
                return False
            names.add(header[4:8])
            end += length
    return end == size and {b"mdat", b"moov"} <= names


class Crops:
    """Writes the new folder `path`: `<class id>_<class name>/<image>_<row>.jpg` for each detection.

    Detections of one image are numbered from 0, the highest score first.
    """

    def __init__(self, path: Path, class_names: Sequence[str]) -> None:
        path.mkdir()
        self._path = path
        # Letters, digits and - stay; all else becomes _.
        names = (re.sub(r"[^\w-]", "_", name)[:_MAX_NAME_LETTERS] for name in class_names)
        self._folders = [path / f"{number}_{name}" for number, name in enumerate(names)]
        self._count = 0

    def write(self, found: DetectedImage) -> None:
        """Write the crops; raises OutputError beyond MAX_CROPS, and OSError when the disk is nearly full."""
        self._check_room(len(found.detections))
        height, width = found.image.size_hw
        name = Path(str(found.stored.identity.get("file", found.stored.stem))).name  # a.png is not a.jpg
        for row, class_id in enumerate(found.detections.class_ids.tolist()):
            x1, y1, x2, y2 = found.inside_xyxy[row].tolist()
            left, top = min(int(x1), width - 1), min(int(y1), height - 1)
            right, bottom = max(int(np.ceil(x2)), left + 1), max(int(np.ceil(y2)), top + 1)
            touched = ColourImage(found.image.pixels[top:bottom, left:right], found.image.channel_order)
            self._folders[class_id].mkdir(exist_ok=True)
            write_image(self._folders[class_id] / f"{name}_{row}.jpg", touched)

    def _check_room(self, count: int) -> None:
        self._count += count
        if self._count > MAX_CROPS:
            raise OutputError(
                f"--crops: more than {MAX_CROPS:,} detections: raise confidence_threshold, select classes, "
                "or divide the source."
            )
        if count and shutil.disk_usage(self._path).free < MIN_FREE_BYTES:
            reason = f"less than {MIN_FREE_BYTES >> 20} MiB are free, which --crops leaves"
            raise OSError(errno.ENOSPC, reason, str(self._path))
