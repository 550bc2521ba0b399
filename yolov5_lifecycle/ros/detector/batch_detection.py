"""Detection in frames of several cameras at once."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence

from sensor_msgs.msg import Image

from yolov5_lifecycle.detection.detector import Detector
from yolov5_lifecycle.images.image import ColourImage
from yolov5_lifecycle.ros.detector.image_input import ReceivedFrame
from yolov5_lifecycle.ros.detector.pipeline import CameraPipeline, DetectedFrame

FrameJob = tuple[CameraPipeline, ReceivedFrame]


class BatchDetection:
    """Detects in frames that wait at the same time, in the batch sizes that `detector` measured as faster.

    Used by the worker, see `streaming.pipeline.Batch`.
    """

    def __init__(self, detector: Detector) -> None:
        self._detector = detector

    @property
    def max_size(self) -> int:
        return max(self._detector.batch_sizes, default=1)

    def key(self, pipeline: CameraPipeline, frame: ReceivedFrame) -> tuple[int, int]:
        """The network input size; a compressed image is assumed to be as large as the last image."""
        message = frame.message
        if isinstance(message, Image):
            return self._detector.network_hw((message.height, message.width))
        return self._detector.network_hw(pipeline.last_image.size_hw)

    def detect(self, jobs: Sequence[FrameJob]) -> list[DetectedFrame | Exception]:
        """A result or error for each of `jobs`."""
        read = [_image_or_error(pipeline, frame) for pipeline, frame in jobs]
        images = {index: image for index, image in enumerate(read) if isinstance(image, ColourImage)}
        results: dict[int, DetectedFrame | Exception] = {
            index: error for index, error in enumerate(read) if isinstance(error, Exception)
        }
        for together in self._batches(images):
            wanted = [jobs[index][0].wanted for index in together]
            found = self._detector.detect_batch([images[index] for index in together], wanted)
            for index, detections in zip(together, found, strict=True):
                if isinstance(detections, Exception):
                    results[index] = detections
                else:
                    results[index] = DetectedFrame(jobs[index][1], images[index], detections)
        return [results[index] for index in range(len(jobs))]

    def _batches(self, images: Mapping[int, ColourImage]) -> Iterator[list[int]]:
        """Indices of images with the same network input size, grouped into worthwhile batches or alone."""
        by_size: defaultdict[tuple[int, int], list[int]] = defaultdict(list)
        for index, image in images.items():
            by_size[self._detector.network_hw(image.size_hw)].append(index)
        for rest in by_size.values():
            while rest:
                count = max((size for size in self._detector.batch_sizes if size <= len(rest)), default=1)
                yield rest[:count]
                del rest[:count]


def _image_or_error(pipeline: CameraPipeline, frame: ReceivedFrame) -> ColourImage | Exception:
    try:
        return pipeline.begin(frame)
    except Exception as error:  # noqa: BLE001 - the result of this frame; the others go on
        return error
