"""Detection in the images of one source, written in one of the formats, and drawn."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from yolov5_lifecycle.atomic_file import whole_output
from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.images.image import ColourImage
from yolov5_lifecycle.offline.detecting import LoadDetector, OfflineDetector, RunStatistics, StoredImage
from yolov5_lifecycle.offline.export.formats import FORMATS, YOLO, DetectedImage, Output, check_stems
from yolov5_lifecycle.offline.export.image_outputs import (
    Crops,
    annotated_images,
    annotated_video,
    check_video_name,
)
from yolov5_lifecycle.offline.image_files import VideoFile, has_still_images, image_files


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
