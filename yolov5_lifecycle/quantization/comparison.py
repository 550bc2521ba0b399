"""How much int8 changes what a network computes: compared with fp32 before int8 is used."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from yolov5_lifecycle.models.model import Model
from yolov5_lifecycle.models.network import Network, fuse
from yolov5_lifecycle.quantization.activation_ranges import network_pixels, reading
from yolov5_lifecycle.quantization.calibration_file import Calibration
from yolov5_lifecycle.quantization.reference import contrast_card
from yolov5_lifecycle.runtimes.networks_by_shape import denormals_as_zero
from yolov5_lifecycle.runtimes.quantization import LEVELS, Activation, activation_step, convolutions
from yolov5_lifecycle.runtimes.runtime import InferenceError, Runtime

MAX_NOISE = 0.3
"""Of a level, on the reference. Honest calibrations have 0.002 to 0.14, one that hides everything 1."""
MAX_CARD_NOISE = 0.5
"""Of a level, on an image that may be unlike those of the calibration; honest ones have 0.001 to 0.3."""
MAX_INPUT_NOISE = 0.5
"""Of what a convolution reads. Honest calibrations have 0.0001 to 0.16, of an image unlike theirs."""
_MAX_GROWTH = 4.0
_NEGLIGIBLE = 0.03
_SMALL_VARIANCE = 0.05  # logits: where fp32 varies less than that, differences below it mean nothing
_SAMPLED = 7  # every seventh value that a convolution reads
_MIN_SCORE = 1e-6
_MIN_ENERGY = 1e-12


@dataclass(frozen=True)
class Comparison:
    """int8 on one frame, fp32 taken as the truth."""

    levels: tuple[float, ...]
    """Of each level, the mean squared error of objectness and class logits over their variance in fp32."""
    inputs: Mapping[str, float]
    """Of each int8 convolution, the share of the energy of its input that is lost by rounding."""


class Fp32Network:
    """The network of `model` in fp32, fused; owns a copy of its weights."""

    def __init__(self, model: Model) -> None:
        self._network: Network = fuse(model.network())
        self._channels = model.architecture.image_channels
        self._classes = len(model.class_names)

    def compare(
        self, int8: Runtime, activations: Mapping[str, Activation], frame: NDArray[np.uint8]
    ) -> Comparison:
        """Run a `frame` (h, w, 3), RGB, in fp32 and in `int8`, whose convolutions read `activations`.

        Raises InferenceError if the engine fails, or if a prediction is not finite.
        """
        found = convolutions(self._network)
        inputs: dict[str, float] = {}
        observers = {
            found[path]: _measuring(path, activation, inputs) for path, activation in activations.items()
        }
        with reading(observers), torch.no_grad(), denormals_as_zero():
            features = self._network.features(network_pixels(frame, "rgb", self._channels))
            truth = self._network.predictions(features)[0].numpy()
        rows = int8(frame, "rgb").rows
        if truth.shape != rows.shape or not (np.isfinite(truth).all() and np.isfinite(rows).all()):
            raise InferenceError("expected the predictions of the same cells, all finite, found others")
        anchors = self._network.head.anchors_per_cell
        cells = [level.shape[2] * level.shape[3] for level in features]
        ends = np.cumsum([anchors * count for count in cells])[:-1]
        levels = zip(
            np.split(self._logits(truth), ends), np.split(self._logits(rows), ends), cells, strict=True
        )
        return Comparison(tuple(_noise(true, other, count) for true, other, count in levels), inputs)

    def _logits(self, rows: NDArray[np.float32]) -> NDArray[np.float64]:
        """(N, 1 + C): of objectness and classes."""
        scores = np.clip(rows[:, 4 : 5 + self._classes].astype(np.float64), _MIN_SCORE, 1 - _MIN_SCORE)
        logits: NDArray[np.float64] = np.log(scores / (1 - scores))
        return logits


def deviation(model: Model, calibration: Calibration, int8: Runtime, frame_hw: tuple[int, int]) -> str:
    """Why `int8`, the network of `model` with `calibration`, is not to be used for `frame_hw`, or "".

    Compared with fp32 on the reference of the calibration and on an image that is always the same: a file can
    choose neither the truth nor the second image. Raises InferenceError.
    """
    quantization = calibration.quantization
    rounded = {
        path: activation
        for path, activation in quantization.activations.items()
        if path not in quantization.fp32_layers
    }
    network = Fp32Network(model)
    reference = calibration.reference
    on_reference = network.compare(int8, rounded, reference.frame(frame_hw))
    if len(reference.noise) != len(on_reference.levels):
        return f"its reference has {len(reference.noise)} levels, this network has {len(on_reference.levels)}"
    limits = [min(MAX_NOISE, _MAX_GROWTH * noise + _NEGLIGIBLE) for noise in reference.noise]
    if problem := _problem(on_reference, limits, "its reference image"):
        return problem
    on_card = network.compare(int8, rounded, contrast_card(frame_hw))
    return _problem(on_card, [MAX_CARD_NOISE] * len(limits), "a generated image")


def _problem(found: Comparison, limits: Sequence[float], image: str) -> str:
    for path, noise in found.inputs.items():
        if not noise <= MAX_INPUT_NOISE:
            return (
                f"on {image} the range of {path} loses {100 * noise:.0f} % of what that convolution reads; "
                f"{100 * MAX_INPUT_NOISE:.0f} % is the limit"
            )
    for number, (noise, limit) in enumerate(zip(found.levels, limits, strict=True)):
        if not noise <= limit:
            return (
                f"on {image} int8 differs from fp32: {noise:.3g} of the variance of level {number}, "
                f"{limit:.3g} is the limit"
            )
    return ""


def _measuring(path: str, read: Activation, noise: dict[str, float]) -> Callable[[Tensor], None]:
    step, zero = activation_step(read.range)

    def measure(values: Tensor) -> None:
        sample = values.flatten()[::_SAMPLED]
        rounded = torch.fake_quantize_per_tensor_affine(sample, float(step), int(zero), 0, LEVELS)
        lost = float((rounded - sample).square().mean() / sample.square().mean().clamp_min(_MIN_ENERGY))
        noise[path] = max(lost, noise.get(path, 0.0))

    return measure


def _noise(truth: NDArray[np.float64], found: NDArray[np.float64], cells: int) -> float:
    """See `Comparison.levels`; of one level, (anchors * cells, outputs) each."""
    by_anchor = truth.reshape(-1, cells, truth.shape[1])
    variance = float(by_anchor.var(axis=1).mean())
    return float(((found - truth) ** 2).mean()) / (variance + _SMALL_VARIANCE)
