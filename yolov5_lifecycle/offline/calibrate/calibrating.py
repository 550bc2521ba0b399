"""Calibration of a model for int8: ranges, layers that stay in fp32, and measurements beside fp32."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch

from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.detection.detector import Detector
from yolov5_lifecycle.detection.nms import Selection
from yolov5_lifecycle.images.image import ColourImage
from yolov5_lifecycle.models.cost import size_multiple
from yolov5_lifecycle.models.model import Model
from yolov5_lifecycle.models.network import fuse
from yolov5_lifecycle.offline.calibrate.calibration_images import halves
from yolov5_lifecycle.offline.calibrate.measuring import Worth, agreement, measured
from yolov5_lifecycle.quantization.activation_ranges import activations, most_sensitive, network_pixels
from yolov5_lifecycle.runtimes.processor_abilities import abilities, has_bf16, weight_bits
from yolov5_lifecycle.runtimes.quantization import Activation, Quantization
from yolov5_lifecycle.runtimes.registry import COARSE_RUNTIME, installed_runtimes, load_runtime

Tell = Callable[[str], None]
"""Shows the current step."""
Loss = Callable[[dict[str, Detector]], float | str]
"""Points of mAP that the detector in int8 loses against that in fp32, or why that is unknown."""
SENSITIVITY_FRAMES = 4
"""Max frames that the network runs at once."""
_FP32_SHARE = 0.5
"""Share of the convolutions that stay in fp32 if need be: those that cost least for what they save."""
_GOOD_AGREEMENT = 0.99


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
        self._bits = weight_bits(abilities())

    def quantization(self) -> Quantization:
        """All layers in int8 if that agrees well with fp32, else half of them.

        Shares in between were tried: a few hundred detections cannot distinguish them.
        """
        read, order = self._activations()
        self._tell("comparing int8 with fp32")
        whole = Quantization(read, frozenset(), self._bits)
        truth = self._detections(self._detector(COARSE_RUNTIME, "fp32"))
        f1, _ = agreement(truth, self._detections(self._detector(COARSE_RUNTIME, "int8", whole)))
        kept = [] if f1 >= _GOOD_AGREEMENT else order[: round(_FP32_SHARE * len(order))]
        return Quantization(read, frozenset(kept), self._bits)

    def worth(self, quantization: Quantization, map_loss: Loss) -> Worth:
        """What int8 with `quantization` is worth on this computer."""
        wanted = [(COARSE_RUNTIME, "fp32"), (COARSE_RUNTIME, "int8")]
        if "onnxruntime" in installed_runtimes():
            wanted.append(("onnxruntime", "fp32"))
        if has_bf16(abilities()):
            wanted.append((COARSE_RUNTIME, "bf16"))
        detectors = {each: self._detector(*each, quantization) for each in wanted}
        measurements, found = measured(detectors, self._compared, self._selection, self._tell)
        lost = map_loss({precision: detectors[COARSE_RUNTIME, precision] for precision in ("fp32", "int8")})
        for detector in detectors.values():
            detector.close()
        return Worth(measurements, found, lost)

    def _activations(self) -> tuple[dict[str, Activation], list[str]]:
        """The activations that convolutions read, and the paths of these, the most sensitive first."""
        network = fuse(self._model.network())
        channels = self._model.architecture.image_channels
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

    def _detections(self, detector: Detector) -> list[Detections]:
        found = [detector.detect(image, self._selection) for image in self._learned]
        detector.close()
        return found

    def _detector(self, runtime: str, precision: str, quantization: Quantization | None = None) -> Detector:
        model = self._model
        return Detector(
            load_runtime(model, runtime, device="cpu", precision=precision, quantization=quantization),
            class_names=model.class_names,
            image_size=max(self._learned[0].size_hw),
            stride=size_multiple(model.architecture),
            mask_coefficients=model.architecture.mask_coefficients,
        )
