"""Detection in the images of one source, written in one of the formats, and drawn."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain
from pathlib import Path

from yolov5_lifecycle.atomic_file import whole_output
from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.images.image import ColourImage
from yolov5_lifecycle.offline.detecting import LoadDetector, OfflineDetector, RunStatistics
from yolov5_lifecycle.offline.export.detected_image import DetectedImage, NamedImage, Sink
from yolov5_lifecycle.offline.export.formats import FORMATS, YOLO, JsonLines, check_stems
from yolov5_lifecycle.offline.export.image_outputs import (
    AnnotatedImages,
    AnnotatedVideo,
    Crops,
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

    def sinks(self, detector: OfflineDetector) -> Iterator[Sink]:
        """Open the outputs for detections of `detector`, except a recording and drawings; raises OSError."""
        names = detector.class_names
        if self.crops is not None:
            yield Crops(self.crops, names)
        if self.path is None:
            yield JsonLines(None, names, masks=self.masks)
        elif self.suffix:
            yield FORMATS[self.suffix](self.path, names, masks=self.masks)


def write_files(source: Path, export: Export, load: LoadDetector) -> RunStatistics:
    """Write the detections in the images or the video `source`; what is written stays on failure.

    Raises SourceError, OutputError, DetectingError and what `load` raises.
    """
    annotated = export.annotated
    if not has_still_images(source):
        video = VideoFile.open(source)
        if annotated:
            check_video_name(annotated)
        film = partial(AnnotatedVideo, annotated, video.rate_hz) if annotated else None
        return export_images(video.frames, video.claimed_frames, export, load, film)
    files = image_files(source)
    if export.suffix == YOLO:
        check_stems(files)
    drawings = partial(AnnotatedImages, annotated, source.is_dir()) if annotated else None
    return export_images(files, len(files), export, load, drawings)


def export_images(
    images: Iterable[NamedImage],
    expected: int,
    export: Export,
    load: LoadDetector,
    further: Callable[[OfflineDetector], Sink] | None = None,
) -> RunStatistics:
    """Write the detections in `images`, of which there are `expected`, and open a `further` output first.

    Raises OutputError, OSError, DetectingError and what `load` raises; then the outputs are damaged.
    """
    detector = load()
    names: dict[str, int] = {}
    with ExitStack() as stack:
        sinks = []
        for sink in chain([further(detector)] if further else [], export.sinks(detector)):
            stack.callback(sink.close)
            sinks.append(sink)

        def write(named: NamedImage, image: ColourImage, detections: Detections) -> None:
            found = DetectedImage(named, image, detections, names)
            for sink in sinks:
                sink.add(found)

        statistics = detector.run(images, expected=expected, write=write)
        for sink in sinks:
            sink.finish()
    return statistics
