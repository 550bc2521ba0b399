"""Detection in images or a video, with JSON lines and annotated images or an annotated video as output."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from typing import TextIO

from yolov5_lifecycle.atomic_file import whole_output
from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.detection.draw import annotate
from yolov5_lifecycle.images.image import ColourImage
from yolov5_lifecycle.offline.annotated_files import VideoOutput, detection_line, write_image
from yolov5_lifecycle.offline.detecting import Account, LoadDetector, OfflineDetector
from yolov5_lifecycle.offline.image_files import (
    ImageFile,
    VideoFile,
    VideoFrame,
    has_still_images,
    image_files,
)


def detect_files(source: Path, output: Path | None, *, annotated: Path | None, load: LoadDetector) -> Account:
    """Write a JSON line for every image of `source` to the new file `output`, or to stdout.

    `annotated` is a new folder if `source` is one, else a new image or video. Raises SourceError,
    OutputError, DetectingError and what `load` raises.
    """
    with ExitStack() as stack:
        lines = stack.enter_context(_text(output)) if output else sys.stdout
        drawings = stack.enter_context(whole_output(annotated)) if annotated else None
        if has_still_images(source):
            return _detect_images(source, lines, drawings, load)
        return _detect_video(source, lines, drawings, load)


def _detect_images(source: Path, lines: TextIO, drawings: Path | None, load: LoadDetector) -> Account:
    files = image_files(source)
    detector = load()
    if drawings and source.is_dir():
        drawings.mkdir()

    def write(file: ImageFile, image: ColourImage, detections: Detections) -> None:
        lines.write(detection_line(file.identity, image, detections, detector.class_names))
        if drawings:
            target = drawings / file.path.name if source.is_dir() else drawings
            write_image(target, _drawn(image, detections, detector))

    return detector.run(files, expected=len(files), write=write)


def _detect_video(source: Path, lines: TextIO, drawings: Path | None, load: LoadDetector) -> Account:
    video = VideoFile.open(source)
    with ExitStack() as stack:
        output = stack.enter_context(closing(VideoOutput(drawings, video.rate_hz))) if drawings else None
        detector = load()

        def write(frame: VideoFrame, image: ColourImage, detections: Detections) -> None:
            lines.write(detection_line(frame.identity, image, detections, detector.class_names))
            if output:
                output.add(_drawn(image, detections, detector))

        return detector.run(video.frames, expected=video.claimed_frames, write=write)


def _drawn(image: ColourImage, detections: Detections, detector: OfflineDetector) -> ColourImage:
    return ColourImage(annotate(image, detections, detector.class_names), image.order)


@contextmanager
def _text(path: Path) -> Iterator[TextIO]:
    with whole_output(path) as unfinished, unfinished.open("w", encoding="utf-8") as file:
        yield file
