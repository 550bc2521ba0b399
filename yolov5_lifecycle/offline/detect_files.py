"""Detection in images or a video, with JSON lines and annotated images or an annotated video as output."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from typing import Any, TextIO

import cv2
import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.atomic_file import OutputError, whole_output
from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.detection.draw import annotate
from yolov5_lifecycle.images.encodings import encoded
from yolov5_lifecycle.images.image import ColourImage
from yolov5_lifecycle.offline.detecting import Account, LoadDetector, OfflineDetector
from yolov5_lifecycle.offline.image_files import (
    ImageFile,
    VideoFile,
    VideoFrame,
    has_still_images,
    image_files,
)
from yolov5_lifecycle.offline.run_lengths import coco_rle
from yolov5_lifecycle.offline.whole_video import is_whole_video
from yolov5_lifecycle.printable import in_one_line, is_utf8

_CODECS = {".mp4": "mp4v", ".avi": "MJPG"}


def detect_files(
    source: Path, output: Path | None, *, annotated: Path | None, masks: bool, load: LoadDetector
) -> Account:
    """Write a JSON line for every image of `source` to the new file `output`, or to stdout.

    `annotated` is a new folder if `source` is one, else a new image or video. With `masks` the lines have
    the masks of a segmentation model. Raises SourceError, OutputError, DetectingError and what `load` raises.
    """
    with ExitStack() as stack:
        lines = stack.enter_context(_text(output)) if output else sys.stdout
        drawings = stack.enter_context(whole_output(annotated)) if annotated else None
        if has_still_images(source):
            return _detect_images(source, lines, drawings, masks=masks, load=load)
        return _detect_video(source, lines, drawings, masks=masks, load=load)


def _detect_images(
    source: Path, lines: TextIO, drawings: Path | None, *, masks: bool, load: LoadDetector
) -> Account:
    files = image_files(source)
    detector = load()
    if drawings and source.is_dir():
        drawings.mkdir()

    def write(file: ImageFile, image: ColourImage, detections: Detections) -> None:
        lines.write(detection_line(file.identity, image, detections, detector.class_names, masks=masks))
        if drawings:
            target = drawings / file.path.name if source.is_dir() else drawings
            write_image(target, _drawn(image, detections, detector))

    return detector.run(files, expected=len(files), write=write)


def _detect_video(
    source: Path, lines: TextIO, drawings: Path | None, *, masks: bool, load: LoadDetector
) -> Account:
    video = VideoFile.open(source)
    with ExitStack() as stack:
        output = stack.enter_context(closing(VideoOutput(drawings, video.rate_hz))) if drawings else None
        detector = load()

        def write(frame: VideoFrame, image: ColourImage, detections: Detections) -> None:
            lines.write(detection_line(frame.identity, image, detections, detector.class_names, masks=masks))
            if output:
                output.add(_drawn(image, detections, detector))

        account = detector.run(video.frames, expected=video.claimed_frames, write=write)
        if output:
            output.finish()
        return account


def _drawn(image: ColourImage, detections: Detections, detector: OfflineDetector) -> ColourImage:
    drawn = annotate(image, detections, detector.class_names, box_filter=detector.box_filter)
    return ColourImage(drawn, image.order)


@contextmanager
def _text(path: Path) -> Iterator[TextIO]:
    with whole_output(path) as unfinished, unfinished.open("w", encoding="utf-8") as file:
        yield file


def write_image(path: Path, drawn: ColourImage) -> None:
    """Write one image in the format given by the file extension; raises OutputError and OSError.

    cv2.imwrite would ignore that the last bytes of a file cannot be written.
    """
    name = in_one_line(path.name)
    if not is_utf8(path.suffix):  # OpenCV 5.0 crashes
        raise OutputError(f"{name}: OpenCV cannot write this image: the extension is not UTF-8.")
    try:
        is_encoded, data = cv2.imencode(path.suffix, encoded(drawn, "bgr8"))
    except cv2.error as error:
        raise OutputError(f"{name}: OpenCV cannot write this image: {error.err}.") from None
    if not is_encoded:
        raise OutputError(f"{name}: OpenCV cannot write this image as {path.suffix}; choose .png or .jpg.")
    path.write_bytes(data)


class VideoOutput:
    """A video file written frame by frame at `rate_hz`; each frame is resized to the size of the first.

    Raises OutputError on construction for an unknown format and for a path that is not UTF-8.
    """

    def __init__(self, path: Path, rate_hz: float) -> None:
        if path.suffix.lower() not in _CODECS:
            raise OutputError(f"{path.name}: expected a video file name that ends in {' or '.join(_CODECS)}.")
        if not is_utf8(str(path)):  # OpenCV 5.0 crashes
            raise OutputError(
                f"{in_one_line(path.name)}: the path of an annotated video must be UTF-8: "
                "choose another --annotated."
            )
        self._path = path
        self._rate_hz = rate_hz
        self._writer: Any = None
        self._size_hw = (0, 0)

    def add(self, drawn: ColourImage) -> None:
        """Append a frame; raises OutputError if this OpenCV cannot write the format."""
        frame: NDArray[np.uint8] = encoded(drawn, "bgr8")
        if self._writer is None:
            self._writer = self._opened(drawn.size_hw)
            self._size_hw = drawn.size_hw
        if frame.shape[:2] != self._size_hw:  # OpenCV silently drops frames of another size
            frame = np.asarray(cv2.resize(frame, self._size_hw[::-1], interpolation=cv2.INTER_AREA), np.uint8)
        self._writer.write(np.ascontiguousarray(frame))

    def finish(self) -> None:
        """Complete the file; raises OutputError if it lacks its end, and OSError."""
        self.close()
        if self._writer is not None and not is_whole_video(self._path):
            raise OutputError(
                f"{self._path.name}: the video could not be written completely; is the disk full?"
            )

    def close(self) -> None:
        if self._writer is not None:
            self._writer.release()

    def _opened(self, size_hw: tuple[int, int]) -> Any:
        codec = cv2.VideoWriter.fourcc(*_CODECS[self._path.suffix.lower()])
        writer = cv2.VideoWriter(str(self._path), codec, self._rate_hz, size_hw[::-1])
        if not writer.isOpened():
            others = " or ".join(suffix for suffix in _CODECS if suffix != self._path.suffix.lower())
            raise OutputError(
                f"{self._path.name}: this OpenCV build cannot write this video format; try {others}."
            )
        return writer


def detection_line(
    identity: Mapping[str, str | int],
    image: ColourImage,
    detections: Detections,
    class_names: Sequence[str],
    *,
    masks: bool,
) -> str:
    """A line of JSON with the `identity` of an image, its size and its detections, boxes in image pixels.

    With `masks` each detection that has a mask gets it as COCO's RLE of the whole image.
    """
    height, width = image.size_hw
    found: list[dict[str, object]] = [
        {"class_name": one.class_name, "score": one.score, "box_xyxy": one.box_xyxy}
        for one in detections.objects(class_names)
    ]
    for one, track_id in zip(found, detections.track_ids, strict=False):  # none without a tracker
        one["id"] = track_id
    if masks and detections.masks is not None:
        for row, one in enumerate(found):
            window, inside = detections.masks.inside_box(row, detections.boxes_xyxy[row])
            one["mask"] = coco_rle(window, inside, detections.masks.size_hw)
    return json.dumps({**identity, "width": width, "height": height, "detections": found}) + "\n"
