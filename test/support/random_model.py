"""A small network with random weights, and a random frame for it."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from yolov5_lifecycle.models.architecture import SIZES, Architecture
from yolov5_lifecycle.models.model import Model, blueprint
from yolov5_lifecycle.models.network import Network

CLASS_NAMES = ("cat", "dog", "cow")
_GAIN = 2.3  # as they are initialised, weights let an image fade away from layer to layer
TINY: Architecture = dataclasses.replace(SIZES["n"], width_multiple=0.125, classes=len(CLASS_NAMES))

TINY_SEGMENT: Architecture = dataclasses.replace(
    TINY, layers=(*TINY.layers[:-1], TINY.layers[-1]._replace(kind="Segment", args=(8, 64)))
)


def random_network(seed: int, architecture: Architecture = TINY) -> Network:
    """A network in evaluation mode, whose predictions depend on what it sees as much as after a training."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        network = Network(architecture).eval()
        for module in network.modules():
            if isinstance(module, nn.BatchNorm2d):
                module.running_mean = 0.2 * torch.randn(module.num_features)
                module.running_var = 0.5 + torch.rand(module.num_features)
                nn.init.uniform_(module.weight, 0.5, 1.5)
                nn.init.normal_(module.bias, std=0.2)
            if isinstance(module, nn.Conv2d):
                module.weight.data *= _GAIN
    return network


def random_model(seed: int = 0, architecture: Architecture = TINY) -> Model:
    return Model(architecture, CLASS_NAMES, random_network(seed, architecture).state_dict())


def random_frame(height: int = 64, width: int = 96) -> NDArray[np.uint8]:
    """The same noise each time."""
    return np.random.default_rng(0).integers(0, 256, (height, width, 3), np.uint8)


def model_with(architecture: Architecture, tensor: Callable[[str, Tensor], Tensor]) -> Model:
    """A model with its anchors; `tensor` makes the other tensors of their keys and of blank ones."""
    state = {key: tensor(key, blank) for key, blank in blueprint(architecture).state_dict().items()}
    strides = torch.tensor(architecture.strides).view(-1, 1, 1)
    state[f"model.{len(architecture.layers) - 1}.anchors"] = torch.tensor(architecture.anchors_px) / strides
    return Model(architecture, tuple(f"class {index}" for index in range(architecture.classes)), state)


def blank_model(architecture: Architecture) -> Model:
    """A model of any size in no time: every weight is the same, and no image shows it anything."""
    return model_with(
        architecture,
        lambda _, blank: torch.full_like(blank, 1 / 1024 if blank.is_floating_point() else 0, device="cpu"),
    )
