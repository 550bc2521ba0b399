"""Calibration of a model for int8, and what it is worth: speed, and agreement with fp32."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import torch

from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.detection.detector import Detector
from yolov5_lifecycle.detection.nms import Selection
from yolov5_lifecycle.detection.prepared_model import load_detector
from yolov5_lifecycle.images.image import ColourImage
from yolov5_lifecycle.models.model import Model
from yolov5_lifecycle.models.network import fuse
from yolov5_lifecycle.offline.calibrate.calibration_images import halves
from yolov5_lifecycle.quantization.activation_ranges import activations, most_sensitive, network_pixels
from yolov5_lifecycle.runtimes.processor import abilities, has_bf16
from yolov5_lifecycle.runtimes.quantization import Activation, Quantization
from yolov5_lifecycle.runtimes.registry import COARSE_RUNTIME, installed_runtimes
from yolov5_lifecycle.runtimes.speed import Taken, median, time_taken
from yolov5_lifecycle.tracking.assignment import iou_matrix

Tell = Callable[[str], None]
"""Shows the current step."""
SENSITIVITY_FRAMES = 4
"""Max frames that the network runs at once."""
_FP32_SHARE = 0.5
"""Share of the convolutions that stay in fp32 if need be: those that cost least for what they save."""
_GOOD_AGREEMENT = 0.99
MIN_SPEEDUP = 1.15
MIN_AGREEMENT = 0.98
MIN_DETECTIONS = 50
_SMALLEST_IOU = 0.5
_WARM_UPS = 3


@dataclass(frozen=True)
class Measurement:
    """A runtime in one precision, measured on the calibration images and compared with fp32."""

    runtime: str
    precision: str
    taken: Taken
    """For an image, the median."""
    f1: float
    """See `agreement`."""


@dataclass(frozen=True)
class Worth:
    """What was measured of int8, once, and of fp32 and others beside it."""

    measured: Sequence[Measurement]
    detections: int
    """Detections of fp32 in the compared images; the fewer, the less is known."""

    def verdict(self, image_size: int) -> str:
        """Whether int8 pays: it must be good, and faster than the fastest fp32. With the line to type."""
        (int8,) = (each for each in self.measured if each.precision == "int8")
        in_fp32 = (each.taken for each in self.measured if each.precision == "fp32")
        fp32 = min(in_fp32, key=lambda taken: taken.wall_ms)
        speedup, saving = fp32.wall_ms / int8.taken.wall_ms, fp32.processor_ms / int8.taken.processor_ms
        told = (
            f"int8 is {speedup:.2f} x as fast as fp32 here ({int8.taken.wall_ms:.1f} ms, not "
            f"{fp32.wall_ms:.1f}; {saving:.2f} x by processor time) and agrees with it to {int8.f1:.3f} (F1)"
        )
        problem = self._disagreement(int8.f1)
        if not problem and min(speedup, saving) < MIN_SPEEDUP:
            problem = f"{told}; it pays from {MIN_SPEEDUP:g} x by both times"
        if problem:
            return f"int8 does not pay: {problem}. Keep precision auto, which is fp32 on a CPU."
        line = "ros2 param set /yolov5 precision int8"
        return f"int8 pays: {told}. With image_size {image_size}, type: {line}"

    def _disagreement(self, f1: float) -> str:
        """Why int8 with this agreement is not good, or not known to be; "" if it is."""
        if self.detections < MIN_DETECTIONS:
            return (
                f"only {self.detections} detections were compared with fp32, which is less than "
                f"{MIN_DETECTIONS}: calibrate with other or more images"
            )
        if f1 < MIN_AGREEMENT:
            return f"int8 agrees with fp32 to {f1:.3f} (F1), which is less than {MIN_AGREEMENT:g}"
        return ""


def measured(
    detectors: Mapping[tuple[str, str], Detector],
    images: Sequence[ColourImage],
    selection: Selection,
    tell: Callable[[str], None],
) -> tuple[list[Measurement], int]:
    """Measurements of `detectors`, by runtime and precision, and the number of detections of the first one.

    They run alternately, so that load affects all equally. The others are compared with the first.
    """
    taken: list[list[Taken]] = [[] for _ in detectors]
    found: list[list[Detections]] = [[] for _ in detectors]
    for detector in detectors.values():
        for _ in range(_WARM_UPS):
            detector.detect(images[0], selection)
    for number, image in enumerate(images):
        for detector, times, detections in zip(detectors.values(), taken, found, strict=True):
            times.append(time_taken(partial(_detect, detector, image, selection, detections)))
        tell(f"measuring: {number + 1} of {len(images)} images")
    measurements = [
        Measurement(*name, median(times), agreement(found[0], others))
        for name, times, others in zip(detectors, taken, found, strict=True)
    ]
    return measurements, sum(map(len, found[0]))


def _detect(detector: Detector, image: ColourImage, selection: Selection, found: list[Detections]) -> None:
    found.append(detector.detect(image, selection))


def agreement(truth: Sequence[Detections], found: Sequence[Detections]) -> float:
    """F1 of what was found in each image, 1 if there is nothing.

    Pairs are of one class and an IoU of at least 0.5, the best found first.
    """
    pairs = 0
    for true, other in zip(truth, found, strict=True):
        free = iou_matrix(other.boxes_xyxy, true.boxes_xyxy)
        free[other.class_ids[:, None] != true.class_ids] = 0
        for row in free:
            if row.max(initial=0) >= _SMALLEST_IOU:
                pairs += 1
                free[:, row.argmax()] = 0
    total = sum(map(len, truth)) + sum(map(len, found))
    return 2 * pairs / total if total else 1.0


class Calibrating:
    """Calibrates `model` on letterboxed `images` of one size.

    Every other image is used for the ranges and the choice of layers, the rest for the measurements; fewer
    than 20 are used for both. Raises DeviceError, InferenceError and ValueError.
    """

    def __init__(
        self, model: Model, images: Sequence[ColourImage], *, selection: Selection, tell: Tell
    ) -> None:
        self._model = model
        self._learned, self._compared = halves(images)
        self._selection = selection
        self._tell = tell

    def quantization(self) -> Quantization:
        """All layers in int8 if that agrees well with fp32, else half of them.

        Shares in between were tried: a few hundred detections cannot distinguish them.
        """
        read, order = self._activations()
        self._tell("comparing int8 with fp32")
        whole = Quantization.of(read)
        truth = self._detections(self._detector(COARSE_RUNTIME, "fp32"))
        f1 = agreement(truth, self._detections(self._detector(COARSE_RUNTIME, "int8", whole)))
        kept = [] if f1 >= _GOOD_AGREEMENT else order[: round(_FP32_SHARE * len(order))]
        return Quantization.of(read, kept)

    def worth(self, quantization: Quantization) -> Worth:
        """What int8 with `quantization` is worth on this computer."""
        wanted = [(COARSE_RUNTIME, "fp32"), (COARSE_RUNTIME, "int8")]
        if "onnxruntime" in installed_runtimes():
            wanted.append(("onnxruntime", "fp32"))
        if has_bf16(abilities()):
            wanted.append((COARSE_RUNTIME, "bf16"))
        detectors = {each: self._detector(*each, quantization) for each in wanted}
        measurements, found = measured(detectors, self._compared, self._selection, self._tell)
        for detector in detectors.values():
            detector.close()
        return Worth(measurements, found)

    def _activations(self) -> tuple[dict[str, Activation], list[str]]:
        """The activations that convolutions read, and the paths of these, the most sensitive first."""
        network = fuse(self._model.network())
        channels = self._model.architecture.image_channels
        frames = [network_pixels(image.pixels, image.channel_order, channels) for image in self._learned]
        read = activations(
            network, frames, progress=lambda done: self._tell(f"ranges: {done} of {len(frames)} images")
        )
        order = most_sensitive(
            network,
            read,
            torch.cat(frames[:: -(-len(frames) // SENSITIVITY_FRAMES)]),
            progress=lambda done: self._tell(f"sensitivity: {done} of {len(read)} layers"),
        )
        return read, order

    def _detections(self, detector: Detector) -> list[Detections]:
        found = [detector.detect(image, self._selection) for image in self._learned]
        detector.close()
        return found

    def _detector(self, runtime: str, precision: str, quantization: Quantization | None = None) -> Detector:
        return load_detector(
            self._model,
            device="cpu",
            precision=precision,
            image_size=max(self._learned[0].size_hw),
            runtime=runtime,
            quantization=quantization,
        )
