"""Drives the detector through every lifecycle transition over its services and checks the results."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass

import numpy as np
from rclpy.qos import QoSProfile
from sensor_msgs.msg import Image
from vision_msgs.msg import Detection2DArray

from yolov5_lifecycle.images.image import ColourImage
from yolov5_lifecycle.ros.demo.driven_detector import DrivenDetector
from yolov5_lifecycle.ros.demo.ground_truth import Sighting, recall, stamp_ns
from yolov5_lifecycle.ros.demo.mask_record import MaskRecord
from yolov5_lifecycle.ros.demo.observer import Observer
from yolov5_lifecycle.ros.demo.outcome import DemonstrationError
from yolov5_lifecycle.ros.messages import image_of_message

WATCHED_MESSAGES = 120
_LATER_MESSAGES = 30
_LOWEST_RECALL = 0.9
_MASKED_IMAGES = 20
_LOWEST_MASK_IOU = 0.8
_RAISED_THRESHOLD = 0.6
_ONLY_CLASS = "circle"
_IMAGE_SIZES = (320, 416)
_SILENCE_S = 1.5
_LONGEST_GAP_S = 2.0
_SEVERAL = 3


@dataclass(frozen=True)
class Phase:
    """Messages received in one configuration; `recall` is NaN if only some objects were requested."""

    name: str
    sightings: tuple[Sighting, ...]
    recall: float = float("nan")

    @property
    def latencies_ms(self) -> tuple[float, float]:
        """Median and 95th percentile of the time from the camera's stamp to the detections' arrival."""
        ordered = sorted(seen.latency_ms for seen in self.sightings)
        return statistics.median(ordered), ordered[int(0.95 * (len(ordered) - 1))]


@dataclass(frozen=True, eq=False)
class Demonstrated:
    """The results of a demonstration."""

    phases: tuple[Phase, ...]
    mask_iou: float
    """Mean over the objects whose masks were compared with the ground truth."""
    annotated: ColourImage


class Demonstration:
    """Drives `detector` with the camera's images and checks its output; calls `report` once per step."""

    def __init__(
        self, observer: Observer, detector: DrivenDetector, *, report: Callable[[str], None]
    ) -> None:
        self._observer = observer
        self._detector = detector
        self._report = report
        self._sightings: list[Sighting] = []
        self._truths: dict[int, Sighting] = {}
        self._annotated: ColourImage | None = None
        observer.create_subscription(Detection2DArray, "/yolov5/detections", self._take, 10)
        observer.create_subscription(Detection2DArray, "/camera/truth", self._take_truth, 10)

    def run(self) -> Demonstrated:
        """Run all phases. Raises DemonstrationError or NoAnswerError."""
        self._report("waiting for the camera and the detector")
        self._observer.wait_for(lambda: bool(self._truths), "messages on /camera/truth")
        self._detector.wait_until_reachable()
        self._detector.expect_state("unconfigured")
        self._detector.transition("configure", "inactive")
        self._detector.transition("activate", "active")
        phases = [self._watch()]
        mask_iou = self._compare_masks()
        annotated = self._annotated_image()
        phases += [self._narrow(), self._swap()]
        self._stop()
        self._detector.transition("activate", "active")
        phases.append(self._watch_again())
        self._stop()
        self._detector.transition("cleanup", "unconfigured")
        return Demonstrated(tuple(phases), mask_iou, annotated)

    def _watch(self) -> Phase:
        self._report(f"watching {WATCHED_MESSAGES} messages")
        seen = self._next(WATCHED_MESSAGES)
        found = recall(seen, self._truths)
        if not found >= _LOWEST_RECALL:
            raise DemonstrationError(
                f"{found:.1%} of the camera's true shapes were found in the right place, "
                f"expected at least {_LOWEST_RECALL:.0%}"
            )
        self._report(f"found {found:.1%} of the true shapes in the right place")
        return Phase("all classes", seen, found)

    def _compare_masks(self) -> float:
        """Compare the masks of the next images with the true pixels of the camera's shapes."""
        self._report(f"comparing the masks of {_MASKED_IMAGES} images")
        topics = {"found": "/yolov5/masks", "true": "/camera/ground_truth_masks"}
        with closing(MaskRecord(self._observer, **topics)) as record:

            def compared() -> list[Sighting]:
                stamps_ns = record.stamps_ns & self._truths.keys()
                return [seen for seen in self._sightings if seen.stamp_ns in stamps_ns]

            self._observer.wait_for(
                lambda: len(compared()) >= _MASKED_IMAGES,
                f"{_MASKED_IMAGES} images on {' and '.join(topics.values())}",
            )
            ious = [iou for seen in compared() for iou in record.ious(seen, self._truths[seen.stamp_ns])]
        mean = statistics.fmean(ious or [0.0])
        if mean < _LOWEST_MASK_IOU:
            raise DemonstrationError(f"mask IoU {mean:.2f}, expected at least {_LOWEST_MASK_IOU}")
        self._report(f"mask IoU {mean:.2f}")
        return mean

    def _annotated_image(self) -> ColourImage:
        """Receive an image from ~/image that shows several objects."""
        self._report("waiting for an annotated image with several objects")
        subscription = self._observer.create_subscription(
            Image, "/yolov5/image", self._take_image, QoSProfile(depth=1)
        )
        self._observer.wait_for(lambda: self._annotated is not None, "an annotated image")
        self._observer.destroy_subscription(subscription)
        assert self._annotated is not None
        return self._annotated

    def _narrow(self) -> Phase:
        before = self._detector.parameter("confidence_threshold")
        self._detector.set(confidence_threshold=_RAISED_THRESHOLD, classes=[_ONLY_CLASS])
        seen = self._next(_LATER_MESSAGES)
        for sighting in seen:
            if (
                set(sighting.class_names) - {_ONLY_CLASS}
                or min(sighting.scores, default=1.0) < _RAISED_THRESHOLD
            ):
                raise DemonstrationError(
                    f"an image taken after the change still gave {sighting.class_names} "
                    f"with scores {sighting.scores}"
                )
        if not any(sighting.class_names for sighting in seen):
            raise DemonstrationError(
                f"no {_ONLY_CLASS} was detected in {len(seen)} images, although the scene has some"
            )
        self._report(
            f"the next {len(seen)} messages have circles only, none scored below {_RAISED_THRESHOLD}"
        )
        self._detector.set(confidence_threshold=before, classes=[])
        return Phase(f"{_ONLY_CLASS} >= {_RAISED_THRESHOLD}", seen)

    def _swap(self) -> Phase:
        """Change the image size, which loads another model while the current one runs."""
        size = next(size for size in _IMAGE_SIZES if size != self._detector.parameter("image_size"))
        begun_ns = time.time_ns()
        self._detector.set(image_size=size)
        took_s = (time.time_ns() - begun_ns) / 1e9
        seen = self._next(_LATER_MESSAGES)
        around = [sighting for sighting in self._sightings if sighting.stamp_ns > begun_ns - 1_000_000_000]
        gap_s = longest_gap_s(around)
        if gap_s > max(_LONGEST_GAP_S, took_s):  # longer only if it waited for the preparation
            raise DemonstrationError(f"no detections for {gap_s:.1f} s while the model was changed")
        self._report(
            f"model prepared and swapped in {took_s:.1f} s, longest gap between messages {gap_s * 1e3:.0f} ms"
        )
        return Phase(f"image_size {size}", seen, recall(seen, self._truths))

    def _watch_again(self) -> Phase:
        seen = self._next(_LATER_MESSAGES)
        self._report("messages have resumed")
        return Phase("activated again", seen, recall(seen, self._truths))

    def _stop(self) -> None:
        self._detector.transition("deactivate", "inactive")
        answered_ns = time.time_ns()
        self._observer.work_for(_SILENCE_S)
        late = [seen for seen in self._sightings if seen.stamp_ns > answered_ns]
        if late:
            raise DemonstrationError(f"{len(late)} messages for images taken after the node was deactivated")
        self._report(f"messages stopped: none in {_SILENCE_S:g} s")

    def _next(self, count: int) -> tuple[Sighting, ...]:
        """Wait for at least `count` messages whose images are stamped after this call."""
        now_ns = time.time_ns()

        def seen() -> list[Sighting]:
            return [sighting for sighting in self._sightings if sighting.stamp_ns > now_ns]

        self._observer.wait_for(lambda: len(seen()) >= count, f"{count} messages on /yolov5/detections")
        return tuple(seen())

    def _take(self, message: Detection2DArray) -> None:
        self._sightings.append(Sighting.now(message))

    def _take_truth(self, message: Detection2DArray) -> None:
        truth = Sighting.now(message)
        self._truths[truth.stamp_ns] = truth

    def _take_image(self, message: Image) -> None:
        image_ns = stamp_ns(message.header)
        objects = [len(seen.scores) for seen in self._sightings if seen.stamp_ns == image_ns]
        if objects and objects[0] >= _SEVERAL:
            self._annotated = image_of_message(message)


def longest_gap_s(sightings: Sequence[Sighting]) -> float:
    """Max time between consecutive arrivals in seconds, 0 for fewer than two."""
    arrivals_ns = sorted(seen.arrival_ns for seen in sightings)
    return max(np.diff(arrivals_ns), default=0) / 1e9
