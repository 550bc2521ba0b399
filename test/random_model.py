"""A small network with random weights, for tests."""

from __future__ import annotations

import dataclasses

import torch
from torch import nn

from yolov5_lifecycle.architecture import SIZES, Architecture
from yolov5_lifecycle.model import Model
from yolov5_lifecycle.network import Network

CLASS_NAMES = ("cat", "dog", "cow")
TINY: Architecture = dataclasses.replace(SIZES["n"], width_multiple=0.125, classes=len(CLASS_NAMES))


def random_network(seed: int, architecture: Architecture = TINY) -> Network:
    """A network in evaluation mode; its normalisation statistics are random too, as after a training."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        network = Network(architecture).eval()
        for module in network.modules():
            if isinstance(module, nn.BatchNorm2d):
                module.running_mean = 0.2 * torch.randn(module.num_features)
                module.running_var = 0.5 + torch.rand(module.num_features)
                nn.init.uniform_(module.weight, 0.5, 1.5)
                nn.init.normal_(module.bias, std=0.2)
    return network


def random_model(seed: int = 0, architecture: Architecture = TINY) -> Model:
    return Model(architecture, CLASS_NAMES, random_network(seed, architecture).state_dict())
