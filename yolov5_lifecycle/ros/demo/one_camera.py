"""One camera: every transition, a live change and a model swap; boxes and masks compared with the truth."""

from __future__ import annotations

import statistics
import time
from typing import Any

import numpy as np
from sensor_msgs.msg import Image
from vision_msgs.msg import Detection2DArray

from yolov5_lifecycle.printable import shell_command
from yolov5_lifecycle.ros.demo.ground_truth import matched
from yolov5_lifecycle.ros.demo.stage import CONFIG, DETECTOR, Stage, saved, together

SEED = 8
COMMANDS = {
    "camera": f"camera --ros-args -p seed:={SEED} -r image_raw:={DETECTOR}/image_raw",
    "detector": f"detector --ros-args --params-file {shell_command(f'{CONFIG}/demo.yaml')}",
}
_FOUND, _TRUTH = f"{DETECTOR}/detections", "/camera/truth"
_MASKS, _TRUE_MASKS = f"{DETECTOR}/masks", "/camera/ground_truth_masks"


class OneCamera:
    """Drives the detector of `stage`."""

    def __init__(self, stage: Stage) -> None:
        self._stage = stage
        self._truths = stage.collect(Detection2DArray, _TRUTH)
        self._found = stage.collect(Detection2DArray, _FOUND)

    def run(self) -> str:
        """Run the demonstration, save an image and return a summary.

        Raises DemonstrationError, TimeoutError or OSError.
        """
        self._stage.transition("configure")
        self._stage.transition("activate")
        summary = f"{self._watch(120)}, {self._compare_masks()}"
        image = self._stage.annotated_image(f"{DETECTOR}/image", self._found, 3)
        path = saved(image, "annotated.png")
        self._narrow()
        self._swap()
        self._stop()
        self._stage.transition("activate")
        self._watch(30)
        self._stop()
        self._stage.transition("cleanup")
        return f"{summary}, image in {path}"

    def _watch(self, count: int) -> str:
        frames = self._next(count)
        right = sum(len(matched(truth, found)) for truth, found in frames.values())
        recall = right / sum(len(truth.detections) for truth, _ in frames.values())
        latency_ms = statistics.median(self._stage.latencies_ms[_FOUND, stamp] for stamp in frames)
        told = f"{recall:.1%} of the shapes found in {len(frames)} images, median latency {latency_ms:.0f} ms"
        self._stage.check(recall >= 0.9, told, "at least 90 %")
        return told

    def _compare_masks(self) -> str:
        found = self._stage.collect(Image, _MASKS, kept=50)
        true = self._stage.collect(Image, _TRUE_MASKS, kept=50)

        def frames() -> list[tuple[Any, ...]]:
            return [*together(self._truths, self._found, true, found).values()]

        self._stage.observer.wait_for(lambda: len(frames()) >= 20, f"20 images on {_MASKS} and {_TRUE_MASKS}")
        self._stage.release(_MASKS, _TRUE_MASKS)
        ious = [iou for truth, seen, *masks in frames() for iou in mask_ious(matched(truth, seen), *masks)]
        mean = statistics.fmean(ious or [0.0])
        self._stage.check(mean >= 0.8, told := f"mask IoU {mean:.2f}", "at least 0.8")
        return told

    def _narrow(self) -> None:
        before = self._stage.node.parameter("confidence_threshold")
        self._stage.set(confidence_threshold=0.6, classes=["circle"])
        frames = self._next(30)
        best = [one.results[0].hypothesis for _, found in frames.values() for one in found.detections]
        names = sorted({one.class_id for one in best})
        lowest = min((one.score for one in best), default=0.0)
        told = (
            f"{len(frames)} images show {' and '.join(names) or 'nothing'}, with scores from {lowest:.2f} on"
        )
        self._stage.check(names == ["circle"] and lowest >= 0.6, told, "only circles, from 0.6 on")
        self._stage.set(confidence_threshold=before, classes=[])

    def _swap(self) -> None:
        """Change the image size, which loads another model while the current one runs."""
        begun_ns = time.time_ns()
        self._stage.set(image_size=416)
        taken_s = (time.time_ns() - begun_ns) / 1e9
        self._watch(30)
        stamps_ns = [stamp for stamp in self._found if stamp > begun_ns - 1_000_000_000]
        gap_s = max(np.diff(stamps_ns)) / 1e9
        told = f"model swapped in {taken_s:.1f} s, longest time without detections {gap_s:.2f} s"
        # Longer only if it waited for the preparation.
        self._stage.check(bool(gap_s <= max(2.0, taken_s)), told, "at most 2 s")

    def _stop(self) -> None:
        self._stage.transition("deactivate")
        answered_ns = time.time_ns()
        self._stage.observer.work_for(1.5)
        late = sum(stamp > answered_ns for stamp in self._found)
        self._stage.check(late == 0, f"{late} detections in images of the next 1.5 s", "none")

    def _next(self, count: int) -> dict[int, tuple[Any, ...]]:
        """True and found objects of at least `count` images that are stamped after this call."""
        now_ns = time.time_ns()

        def frames() -> dict[int, tuple[Any, ...]]:
            known = together(self._truths, self._found)
            return {stamp: messages for stamp, messages in known.items() if stamp > now_ns}

        self._stage.observer.wait_for(lambda: len(frames()) >= count, f"{count} messages on {_FOUND}")
        return frames()


def mask_ious(pairs: list[tuple[int, int]], true: Image, found: Image) -> list[float]:
    """Intersection over union of the pixels of the true and the found object of each pair of rows.

    The images are 16UC1, with i + 1 for the pixels of the i-th object.
    """
    labels = [np.frombuffer(image.data, "<u2").reshape(image.height, image.width) for image in (true, found)]
    masks = [(labels[0] == i + 1, labels[1] == j + 1) for i, j in pairs]
    return [float((a & b).sum() / max((a | b).sum(), 1)) for a, b in masks]
