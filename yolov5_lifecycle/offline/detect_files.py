"""Detection in images or a video, with exported detections and annotated images or an annotated video."""

from __future__ import annotations

import functools
from contextlib import ExitStack, closing
from pathlib import Path

from yolov5_lifecycle.atomic_file import whole_output
from yolov5_lifecycle.detection.draw import annotate
from yolov5_lifecycle.images.image import ColourImage
from yolov5_lifecycle.offline.annotated_files import VideoOutput, write_image
from yolov5_lifecycle.offline.detecting import LoadDetector, OfflineDetector, RunStatistics
from yolov5_lifecycle.offline.export.detected_image import DetectedImage
from yolov5_lifecycle.offline.export.exporting import Export, export_images, whole_export
from yolov5_lifecycle.offline.export.formats import FORMATS
from yolov5_lifecycle.offline.image_files import VideoFile, has_still_images, image_files


def detect_files(
    source: Path, export: Export, *, annotated: Path | None, load: LoadDetector
) -> RunStatistics:
    """`write_files`, with outputs that appear when they are complete, or not at all.

    Raises SourceError, OutputError, DetectingError and what `load` raises.
    """
    with whole_export(export) as unfinished, ExitStack() as stack:
        drawings = stack.enter_context(whole_output(annotated)) if annotated else None
        return write_files(source, unfinished, annotated=drawings, load=load)


def write_files(source: Path, export: Export, *, annotated: Path | None, load: LoadDetector) -> RunStatistics:
    """Write the detections in the images or the video `source`; what is written stays on failure.

    `annotated` is a new folder if `source` is one, else a new image or video.
    """
    if has_still_images(source):
        files = image_files(source)
        if check_images := FORMATS[export.suffix].check_images:
            check_images(files)
        images = functools.partial(_DrawnImages, annotated, source.is_dir()) if annotated else None
        return export_images(files, len(files), export, load=load, drawings=images)
    video = VideoFile.open(source)
    with ExitStack() as stack:
        output = stack.enter_context(closing(VideoOutput(annotated, video.rate_hz))) if annotated else None
        drawings = None if output is None else functools.partial(_DrawnVideo, output)
        return export_images(video.frames, video.claimed_frames, export, load=load, drawings=drawings)


class _DrawnImages:
    """Annotated images in the new folder `path`, or a single one. See `Sink`."""

    def __init__(self, path: Path, is_folder: bool, detector: OfflineDetector) -> None:
        self._path = path
        self._is_folder = is_folder
        self._detector = detector
        if is_folder:
            path.mkdir()

    def add(self, found: DetectedImage) -> None:
        name = Path(str(found.named.identity["file"])).name
        write_image(self._path / name if self._is_folder else self._path, _drawn(found, self._detector))

    def finish(self) -> None:
        """Nothing is left: each file is complete."""

    def close(self) -> None:
        """Nothing is open."""


class _DrawnVideo:
    """Annotated frames in the open video `output`. See `Sink`."""

    def __init__(self, output: VideoOutput, detector: OfflineDetector) -> None:
        self._output = output
        self._detector = detector

    def add(self, found: DetectedImage) -> None:
        self._output.add(_drawn(found, self._detector))

    def finish(self) -> None:
        self._output.finish()

    def close(self) -> None:
        self._output.close()


def _drawn(found: DetectedImage, detector: OfflineDetector) -> ColourImage:
    drawn = annotate(found.image, found.detections, detector.class_names, box_filter=detector.box_filter)
    return ColourImage(drawn, found.image.order)
