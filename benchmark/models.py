"""The weights that a run is about."""

from __future__ import annotations

from pathlib import Path

from yolov5_lifecycle.architecture import SIZES
from yolov5_lifecycle.model import Model
from yolov5_lifecycle.network import Network
from yolov5_lifecycle.safetensors_file import write_safetensors


def untrained_weights(size: str, folder: Path) -> Path:
    """A file in `folder` with a network of the official size `size`, as fast as a trained one."""
    path = folder / f"untrained-{size}.safetensors"
    architecture = SIZES[size]
    names = tuple(f"class {index}" for index in range(architecture.classes))
    write_safetensors(Model(architecture, names, Network(architecture).state_dict()), path)
    return path
