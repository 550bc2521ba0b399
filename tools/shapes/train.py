"""Trains the embedded model: `python -m tools.shapes.train --out weights/shapes.safetensors`."""

from __future__ import annotations

import argparse
import logging
import math
from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor, nn

from tools.shapes.images import Batch
from tools.shapes.learning import as_input, learned
from tools.shapes.loss import detection_loss
from yolov5_lifecycle.checkpoints.safetensors_file import write_safetensors
from yolov5_lifecycle.models.architecture import Architecture
from yolov5_lifecycle.models.model import Model, checked_model
from yolov5_lifecycle.models.network import Network
from yolov5_lifecycle.sources.scene import CLASS_NAMES

SEED = 20_250_101
STEPS = 4_500
ARCHITECTURE = Architecture(
    depth_multiple=0.33,
    width_multiple=0.125,
    classes=len(CLASS_NAMES),
    # The boxes of regular shapes are nearly square, so only the size of an anchor matters.
    anchors_px=(
        ((18, 18), (25, 25), (36, 36)),
        ((50, 50), (70, 70), (100, 100)),
        ((140, 140), (200, 200), (280, 280)),
    ),
    strides=(8, 16, 32),
)
OBJECTNESS_SHIFT = 1.4
"""Logits subtracted from every objectness after the training, so that precision and recall are similar at the
default threshold: chosen among 0.6, 1.0 and 1.4 on 150 images of seed 7."""
_PEAK_LEARNING_RATE = 3e-3


def train(*, seed: int, steps: int) -> Network:
    """Train a network on `steps` batches; returned in evaluation mode, reproducible on one machine."""
    torch.manual_seed(seed)
    network = learned(_fresh_network(), _loss, seed=seed, steps=steps, peak_learning_rate=_PEAK_LEARNING_RATE)
    lower_objectness(network, OBJECTNESS_SHIFT)
    return network.eval()


def lower_objectness(network: Network, shift: float) -> None:
    """Subtract `shift` from the objectness logits, in place."""
    for bias in _head_biases(network):
        bias[:, 4] -= shift


def _head_biases(network: Network) -> list[Tensor]:
    """Views of the biases (anchors, 5 + C) of each level."""
    detect = network.head
    biases = [convolution.bias for convolution in detect.m if isinstance(convolution, nn.Conv2d)]
    return [bias.detach().view(detect.anchors_per_cell, -1) for bias in biases if bias is not None]


def _fresh_network() -> Network:
    """A network with random weights; scores start at the average of an image with a few shapes."""
    network = Network(ARCHITECTURE)
    for bias, stride in zip(_head_biases(network), ARCHITECTURE.strides, strict=True):
        bias[:, 4] = math.log(8 / (640 / stride) ** 2)
        bias[:, 5:] = math.log(1 / (len(CLASS_NAMES) - 1))
    network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]  # missing from its overloads
    return network


def _loss(network: Network, batch: Batch) -> Tensor:
    return detection_loss(network.heads(as_input(batch.pixels)), batch.targets, network.architecture)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True, help="the .safetensors file to write")
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("--steps", type=int, default=STEPS)
    arguments = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    network = train(seed=arguments.seed, steps=arguments.steps)
    write_safetensors(model_of(network.architecture, network.state_dict()), arguments.out)


def model_of(architecture: Architecture, state_dict: Mapping[str, Tensor]) -> Model:
    """The model of a network that knows CLASS_NAMES, with weights rounded to fp16."""
    tensors = {
        key: tensor.half().float() if tensor.is_floating_point() else tensor
        for key, tensor in state_dict.items()
    }
    return checked_model(architecture, CLASS_NAMES, tensors)


if __name__ == "__main__":
    main()
