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
from yolov5_lifecycle.images.image import Picture
from yolov5_lifecycle.offline.annotated_files import VideoOutput, detection_line, write_picture
from yolov5_lifecycle.offline.detecting import Account, LoadDetector, OfflineDetector
from yolov5_lifecycle.offline.picture_files import (
    PictureFile,
    VideoFile,
    VideoFrame,
    is_picture,
    picture_files,
)


def detect_files(source: Path, output: Path | None, *, annotated: Path | None, load: LoadDetector) -> Account:
    """Write a JSON line for every image of `source` to the new file `output`, or to stdout.

    `annotated` is a new folder if `source` is one, else a new image or video. Raises SourceError,
    OutputError, DetectingError and what `load` raises.
    """
    with ExitStack() as stack:
        lines = stack.enter_context(_text(output)) if output else sys.stdout
        drawings = stack.enter_context(whole_output(annotated)) if annotated else None
        if source.is_dir() or is_picture(source):
            return _detect_pictures(source, lines, drawings, load)
        return _detect_video(source, lines, drawings, load)


def _detect_pictures(source: Path, lines: TextIO, drawings: Path | None, load: LoadDetector) -> Account:
    files = picture_files(source)
    detector = load()
    if drawings and source.is_dir():
        drawings.mkdir()

    def write(file: PictureFile, picture: Picture, detections: Detections) -> None:
        lines.write(detection_line(file.identity, picture, detections, detector.class_names))
        if drawings:
            target = drawings / file.path.name if source.is_dir() else drawings
            write_picture(target, _drawn(picture, detections, detector))

    return detector.run(files, expected=len(files), write=write)


def _detect_video(source: Path, lines: TextIO, drawings: Path | None, load: LoadDetector) -> Account:
    video = VideoFile.open(source)
    with ExitStack() as stack:
        output = stack.enter_context(closing(VideoOutput(drawings, video.rate_hz))) if drawings else None
        detector = load()

        def write(frame: VideoFrame, picture: Picture, detections: Detections) -> None:
            lines.write(detection_line(frame.identity, picture, detections, detector.class_names))
            if output:
                output.add(_drawn(picture, detections, detector))

        return detector.run(video.frames, expected=video.claimed_frames, write=write)


def _drawn(picture: Picture, detections: Detections, detector: OfflineDetector) -> Picture:
    return Picture(annotate(picture, detections, detector.class_names), picture.order)


@contextmanager
def _text(path: Path) -> Iterator[TextIO]:
    with whole_output(path) as unfinished, unfinished.open("w", encoding="utf-8") as file:
        yield file
