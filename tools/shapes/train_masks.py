"""Teaches the embedded model to segment: `python -m tools.shapes.train_masks --out FILE.safetensors`.

All layers of the detection model are kept, and so are its detections. Only the mask branch is trained.
"""

from __future__ import annotations

import argparse
import logging
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor, nn

from tools.shapes.images import Batch
from tools.shapes.learning import as_input, learned
from tools.shapes.loss import mask_loss
from tools.shapes.train import model_of
from yolov5_lifecycle.checkpoints.locate import load_weights
from yolov5_lifecycle.checkpoints.safetensors_file import write_safetensors
from yolov5_lifecycle.models.architecture import Architecture, Layer
from yolov5_lifecycle.models.head import Detect, Proto
from yolov5_lifecycle.models.model import Model

DETECTING = Path("weights/shapes.safetensors")
SEED = 20_250_102
STEPS = 2_500
_COEFFICIENTS = 32
_PROTOTYPE_CHANNELS = 256  # before the width multiple
_PEAK_LEARNING_RATE = 3e-3


class MaskBranch(nn.Module):
    """The parts of Segment that Detect lacks: coefficients of each prediction, and prototypes.

    `architecture` segments; `detect` is the head beside it.
    """

    def __init__(self, architecture: Architecture, detect: Detect) -> None:
        super().__init__()
        self.anchors = detect.anchors_per_cell
        channels = [convolution.in_channels for convolution in detect.m if isinstance(convolution, nn.Conv2d)]
        outputs = self.anchors * architecture.mask_coefficients
        self.m = nn.ModuleList(nn.Conv2d(channels_in, outputs, 1) for channels_in in channels)
        self.proto = Proto(channels[0], architecture.prototype_channels, architecture.mask_coefficients)
        self.to(memory_format=torch.channels_last)  # type: ignore[call-overload]  # missing from its overloads

    def forward(self, features: list[Tensor]) -> tuple[list[Tensor], Tensor]:
        """Coefficients of each level (B, anchors, ny, nx, M), and prototypes (B, M, h, w)."""
        coefficients = [
            convolution(level).unflatten(1, (self.anchors, -1)).permute(0, 1, 3, 4, 2)
            for convolution, level in zip(self.m, features, strict=True)
        ]
        return coefficients, self.proto(features[0])


def train_masks(model: Model, *, seed: int, steps: int) -> Model:
    """A model that segments, and detects what `model` does, trained on `steps` batches."""
    torch.manual_seed(seed)
    architecture = segmenting(model.architecture)
    network = model.network().eval()
    network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]  # missing from its overloads

    def loss_of(branch: MaskBranch, batch: Batch) -> Tensor:
        with torch.no_grad():
            features = network.features(as_input(batch.pixels))
        coefficients, prototypes = branch(features)
        return mask_loss(coefficients, prototypes, batch.targets, batch.masks, architecture)

    branch = learned(
        MaskBranch(architecture, network.head),
        loss_of,
        seed=seed,
        steps=steps,
        peak_learning_rate=_PEAK_LEARNING_RATE,
    )
    return joined(model, architecture, branch)


def segmenting(architecture: Architecture) -> Architecture:
    """The same with Segment instead of Detect."""
    *layers, detect = architecture.layers
    layers.append(Layer(detect.sources, 1, "Segment", (_COEFFICIENTS, _PROTOTYPE_CHANNELS)))
    return replace(architecture, layers=tuple(layers))


def joined(model: Model, architecture: Architecture, branch: MaskBranch) -> Model:
    """The model of `architecture`, which segments, with the weights of `model` and `branch`."""
    head = f"model.{len(architecture.layers) - 1}"
    tensors = dict(model.state_dict)
    for key, tensor in branch.state_dict().items():
        name = f"{head}.{key}"
        tensors[name] = _side_by_side(tensors[name], tensor, branch.anchors) if name in tensors else tensor
    return model_of(architecture, tensors)


def _side_by_side(detecting: Tensor, tensor: Tensor, anchors: int) -> Tensor:
    """The parameter of a convolution whose outputs are, for each anchor, those of both."""
    outputs = [one.unflatten(0, (anchors, -1)) for one in (detecting, tensor)]
    return torch.cat(outputs, dim=1).flatten(0, 1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--model", type=Path, default=DETECTING, help="the weights file that detects")
    parser.add_argument("--out", type=Path, required=True, help="the .safetensors file to write")
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("--steps", type=int, default=STEPS)
    arguments = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    model = load_weights(arguments.model).model
    write_safetensors(train_masks(model, seed=arguments.seed, steps=arguments.steps), arguments.out)


if __name__ == "__main__":
    main()
