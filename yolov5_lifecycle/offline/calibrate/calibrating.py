"""Calibration of a model for int8: ranges, layers that stay in fp32, and measurements beside fp32."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from importlib.metadata import distributions
from typing import Literal

import torch

from yolov5_lifecycle.checkpoints.locate import WeightsFile
from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.detection.detector import Detector
from yolov5_lifecycle.detection.nms import Selection
from yolov5_lifecycle.images.image import ColourImage
from yolov5_lifecycle.models.cost import size_multiple
from yolov5_lifecycle.models.model import Model
from yolov5_lifecycle.models.network import fuse
from yolov5_lifecycle.offline.calibrate.agreement import agreement
from yolov5_lifecycle.offline.calibrate.calibration_frames import halves
from yolov5_lifecycle.quantization.activation_ranges import activations, network_pixels
from yolov5_lifecycle.quantization.calibration_file import Calibration, Measurement
from yolov5_lifecycle.quantization.comparison import Fp32Network
from yolov5_lifecycle.quantization.reference import Reference, reduced
from yolov5_lifecycle.quantization.sensitivity import most_sensitive
from yolov5_lifecycle.runtimes.auto import computer_digest
from yolov5_lifecycle.runtimes.cache import processor
from yolov5_lifecycle.runtimes.processor_abilities import abilities, has_bf16, weight_bits
from yolov5_lifecycle.runtimes.quantization import Activation, Quantization
from yolov5_lifecycle.runtimes.registry import COARSE_RUNTIME, installed_runtimes, load_runtime
from yolov5_lifecycle.runtimes.speed import Taken, median, time_taken

Tell = Callable[[str], None]
"""Shows the current step."""
Loss = Callable[[Detector, Detector], float | None]
"""Points of mAP that the second detector, in int8, loses against the first in fp32; None if unknown."""
_PACKAGES = ("yolov5_lifecycle", "openvino", "onnxruntime", "torch")
SENSITIVITY_FRAMES = 4
"""Max frames that the network runs at once."""
_FP32_SHARE = 0.5
"""Share of the convolutions that stay in fp32 if need be: those that cost least for what they save."""
_GOOD_AGREEMENT = 0.99
_WARM_UPS = 3

Runtime = Literal["onnxruntime", "openvino"]
Precision = Literal["fp32", "int8", "bf16"]


class Calibrating:
    """Calibrates the model of `weights` on letterboxed `images` of one size.

    Every other image is used for the ranges and the choice of layers, the rest for the measurements; fewer
    than 20 are used for both. `map_loss` is called with the detectors that are measured.
    """

    def __init__(
        self,
        weights: WeightsFile,
        images: Sequence[ColourImage],
        *,
        image_size: int,
        selection: Selection,
        tell: Tell,
        map_loss: Loss = lambda *_: None,
    ) -> None:
        self._weights = weights
        self._images = images
        self._learned, self._compared = halves(images)
        self._image_size = image_size
        self._selection = selection
        self._tell = tell
        self._map_loss = map_loss
        self._bits = weight_bits(abilities())

    def result(self) -> Calibration:
        """The calibration. Raises RuntimeAbsentError, InferenceError and ValueError."""
        read, order = self._activations()
        quantization, shown = self._chosen(read, order)
        reference = self._reference(quantization, shown)
        measured, found = self._measured(quantization)
        return Calibration(
            weights_sha256=self._weights.sha256,
            data_sha256=_digest(self._images),
            images=len(self._images),
            image_size=self._image_size,
            confidence_threshold=self._selection.confidence_threshold,
            iou_threshold=self._selection.iou_threshold,
            weight_bits=self._bits,
            ranges={name: each.range for name, each in read.items()},
            means={name: each.means for name, each in read.items()},
            fp32_layers=tuple(sorted(quantization.fp32_layers)),
            reference=reference,
            detections=found,
            measured=measured,
            computer_sha256=computer_digest(),
            processor=_processor_name(),
            abilities=abilities(),
            versions=_versions(),
        )

    def _activations(self) -> tuple[dict[str, Activation], list[str]]:
        """The activations that convolutions read, and the paths of these, the most sensitive first."""
        network = fuse(self._weights.model.network())
        channels = self._weights.model.architecture.image_channels
        frames = [network_pixels(image.pixels, image.order, channels) for image in self._learned]
        read = activations(
            network, frames, progress=lambda done: self._tell(f"ranges: {done} of {len(frames)} images")
        )
        order = most_sensitive(
            network,
            read,
            torch.cat(frames[:: -(-len(frames) // SENSITIVITY_FRAMES)]),
            weight_bits=self._bits,
            progress=lambda done: self._tell(f"sensitivity: {done} of {len(read)} layers"),
        )
        return read, order

    def _chosen(
        self, read: Mapping[str, Activation], order: Sequence[str]
    ) -> tuple[Quantization, ColourImage]:
        """All layers in int8 if that agrees well, else half of them; and the image that shows most objects.

        Shares in between were tried: a few hundred detections cannot distinguish them.
        """
        truth = self._detections(self._detector(COARSE_RUNTIME, "fp32"), self._learned)
        shown = max(zip(truth, self._learned, strict=True), key=lambda pair: len(pair[0]))[1]
        self._tell("comparing int8 with fp32")
        whole = Quantization(read, frozenset(), self._bits)
        found = self._detections(self._detector(COARSE_RUNTIME, "int8", whole), self._learned)
        if agreement(truth, found).f1 >= _GOOD_AGREEMENT:
            return whole, shown
        return Quantization(read, frozenset(order[: round(_FP32_SHARE * len(order))]), self._bits), shown

    def _reference(self, quantization: Quantization, shown: ColourImage) -> Reference:
        """`shown`, reduced, and what int8 changes in it."""
        model = self._weights.model
        size_hw, rgb = reduced(shown)
        reference = Reference(size_hw=size_hw, rgb=rgb, noise=(0.0,))
        int8 = load_runtime(model, COARSE_RUNTIME, device="cpu", precision="int8", quantization=quantization)
        found = Fp32Network(model).compare(int8, {}, reference.frame(shown.size_hw))
        int8.close()
        noise = tuple(float(f"{level:.4g}") for level in found.levels)
        return reference.model_copy(update={"noise": noise})

    def _measured(self, quantization: Quantization) -> tuple[tuple[Measurement, ...], int]:
        """The measurements, and the number of detections in fp32."""
        wanted: list[tuple[Runtime, Precision]] = [(COARSE_RUNTIME, "fp32"), (COARSE_RUNTIME, "int8")]
        if "onnxruntime" in installed_runtimes():
            wanted.append(("onnxruntime", "fp32"))
        if has_bf16(abilities()):
            wanted.append((COARSE_RUNTIME, "bf16"))
        detectors = {(name, kind): self._detector(name, kind, quantization) for name, kind in wanted}
        taken, found = self._timed(list(detectors.values()))
        truth = found[0]
        lost = self._map_loss(detectors[COARSE_RUNTIME, "fp32"], detectors[COARSE_RUNTIME, "int8"])
        measured = []
        for (runtime, precision), times, others in zip(detectors, taken, found, strict=True):
            same, usual = agreement(truth, others), median(times)
            measured.append(
                Measurement(
                    runtime=runtime,
                    precision=precision,
                    ms_per_image=usual.wall_ms,
                    processor_ms_per_image=usual.processor_ms,
                    agreement_f1=round(same.f1, 4),
                    box_iou=round(same.box_iou, 4),
                    map_loss=lost if precision == "int8" else None,
                )
            )
        return tuple(measured), sum(map(len, truth))

    def _timed(self, detectors: Sequence[Detector]) -> tuple[list[list[Taken]], list[list[Detections]]]:
        """Times and detections of the detectors, run alternately, so that load affects all equally."""
        taken: list[list[Taken]] = [[] for _ in detectors]
        found: list[list[Detections]] = [[] for _ in detectors]
        for detector in detectors:
            for _ in range(_WARM_UPS):
                detector.detect(self._compared[0], self._selection)
        for number, image in enumerate(self._compared):
            for detector, times, detections in zip(detectors, taken, found, strict=True):
                times.append(time_taken(partial(_detect, detector, image, self._selection, detections)))
            self._tell(f"measuring: {number + 1} of {len(self._compared)} images")
        return taken, found

    def _detections(self, detector: Detector, images: Sequence[ColourImage]) -> list[Detections]:
        found = [detector.detect(image, self._selection) for image in images]
        detector.close()
        return found

    def _detector(self, runtime: str, precision: str, quantization: Quantization | None = None) -> Detector:
        model: Model = self._weights.model
        loaded = load_runtime(model, runtime, device="cpu", precision=precision, quantization=quantization)
        return Detector(
            loaded,
            class_names=model.class_names,
            image_size=max(self._images[0].size_hw),
            stride=size_multiple(model.architecture),
            mask_coefficients=model.architecture.mask_coefficients,
        )


def _detect(detector: Detector, image: ColourImage, selection: Selection, found: list[Detections]) -> None:
    found.append(detector.detect(image, selection))


def _digest(images: Sequence[ColourImage]) -> str:
    digest = hashlib.sha256()
    for image in images:
        digest.update(f"{image.size_hw} {image.order} ".encode())
        digest.update(image.pixels.tobytes())
    return digest.hexdigest()


def _processor_name() -> str:
    """The processor's model name, or its architecture if it has none."""
    lines = processor().splitlines()
    named = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return (named or lines)[0][:200]


def _versions() -> dict[str, str]:
    installed = {each.name: each.version for each in distributions() if each.name in _PACKAGES}
    return dict(sorted(installed.items()))
