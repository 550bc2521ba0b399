"""Valid small weights files whose networks would take up the memory or the time of any machine."""

from __future__ import annotations

import dataclasses
import functools
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path

from support.checkpoint_builder import SMALL, official_model, saved, stripped
from support.random_model import random_network
from yolov5_lifecycle.checkpoints.safetensors_file import write_safetensors
from yolov5_lifecycle.models.architecture import Architecture, Layer
from yolov5_lifecycle.models.model import Model


def _layer(kind: str, *args: int, sources: tuple[int, ...] = (-1,)) -> Layer:
    return Layer(sources, 1, kind, args)


_JOIN = _layer("Concat", sources=(-1,) * 16)
_UP, _EIGHTH = _layer("Upsample"), _layer("MaxPool2d", 8, 8, 0)
_BEFORE_HEAD = len(SMALL.layers) - 1


def _with(*layers: Layer) -> Architecture:
    """SMALL with more layers before the head, which reads none of them."""
    return dataclasses.replace(SMALL, layers=(*SMALL.layers[:-1], *layers, SMALL.layers[-1]))


_MANY_KEPT = _with(
    *(_UP, _UP),
    *[_layer("Concat", sources=(_BEFORE_HEAD + 1,) * 16)] * 24,
    *(_layer("MaxPool2d", 2, 2, 0, sources=(_BEFORE_HEAD + 2 + index,)) for index in range(24)),
)
MANY_PREDICTIONS = dataclasses.replace(
    SMALL,
    classes=10_000,
    anchors_px=(tuple((8.0 + anchor, 8.0) for anchor in range(32)),),
    strides=(2,),
    layers=(_layer("Conv", 64, 6, 2), _layer("Detect", sources=(0,))),
)
"""Its file has 5 MB: the head has weights for each class and anchor."""

REFUSED: Mapping[str, tuple[Architecture, str]] = {
    "five times 16 equal inputs": (
        _with(*[_JOIN] * 5),
        "layer 10 (Concat) would have 33,554,432 elements for an image of 128x128, at most 4,194,304",
    ),
    "squares that become channels": (
        _with(_layer("Contract", 8), _layer("Contract", 8), _layer("Concat", sources=(9,) * 4)),
        "layer 10 (Concat) would have 131,072 channels, at most 65,536",
    ),
    "six times twice the size": (
        _with(*[_UP] * 6, _EIGHTH, _EIGHTH),
        "layer 12 (Upsample) would have 8,388,608 elements for an image of 128x128, at most 4,194,304",
    ),
    "a hundred times twice the size": (_with(*[_UP] * 100), "layer 12 (Upsample) would have 8,388,608"),
    "channels that become squares": (
        _with(*[_JOIN, _layer("Expand", 4)] * 10),
        "layer 12 (Concat) would have 33,554,432 elements",
    ),
    "transposed convolutions": (
        _with(*[_layer("ConvTranspose2d", 64, 8, 8)] * 3),
        "layer 9 (ConvTranspose2d) would have 33,554,432 elements",
    ),
    "24 large layers that are read again": (_MANY_KEPT, "layer 34 (MaxPool2d) would keep 208 MB of features"),
    "10,000 classes, 32 anchors for every second pixel": (
        MANY_PREDICTIONS,
        "layer 1 (Detect) would keep 15.7 GB of features and predictions for an image of 128x128, at most",
    ),
}
"""By name; and what the refusal says."""

SMALL_FILES = tuple(
    architecture for architecture, _ in REFUSED.values() if architecture is not MANY_PREDICTIONS
)


def _names(architecture: Architecture) -> tuple[str, ...]:
    return tuple(f"class {index}" for index in range(architecture.classes))


def _model(architecture: Architecture) -> Model:
    return Model(architecture, _names(architecture), random_network(0, architecture).state_dict())


def checkpoint(architecture: Architecture) -> bytes:
    return saved(stripped(official_model(architecture, _names(architecture))))


def safetensors(architecture: Architecture) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "costly.safetensors"
        write_safetensors(_model(architecture), path)
        return path.read_bytes()


def _files(write: Callable[[Architecture], bytes]) -> Mapping[str, tuple[Callable[[], bytes], str]]:
    return {
        name: (functools.partial(write, architecture), told) for name, (architecture, told) in REFUSED.items()
    }


CHECKPOINTS, SAFETENSORS = _files(checkpoint), _files(safetensors)
