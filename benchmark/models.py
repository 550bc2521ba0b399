"""Weights files for benchmarks."""

from __future__ import annotations

from pathlib import Path

from torch import nn

from yolov5_lifecycle.checkpoints.safetensors_file import write_safetensors
from yolov5_lifecycle.models.architecture import SIZES, Architecture
from yolov5_lifecycle.models.model import Model
from yolov5_lifecycle.models.network import Network

_OBJECTNESS_LOGIT = -6.0


def untrained_weights(size: str, folder: Path) -> Path:
    """A file in `folder` with an untrained network of the official size `size`, as fast as a trained one."""
    return untrained_network(SIZES[size], folder / f"untrained-{size}.safetensors")


def untrained_network(architecture: Architecture, path: Path) -> Path:
    """The file at `path`, with an untrained network of `architecture`."""
    names = tuple(f"class {index}" for index in range(architecture.classes))
    write_safetensors(Model(architecture, names, _sceptical(Network(architecture)).state_dict()), path)
    return path


def _sceptical(network: Network) -> Network:
    """Lower the scores: otherwise half of all boxes would be objects, and NMS dominate the measurement."""
    detect = network.head
    for convolution in detect.m:
        assert isinstance(convolution, nn.Conv2d)
        assert convolution.bias is not None
        convolution.bias.data.view(detect.anchors_per_cell, -1)[:, 4] = _OBJECTNESS_LOGIT
    return network
