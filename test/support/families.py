"""Models of every family that YOLOv5's code has trained, and what its implementation computes with them.

The architectures are those of `test/data/families.json`; weights and pixels follow the formula of
`support/formula_model.py`.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import json
from collections.abc import Mapping
from typing import Any

import pytest
import torch

from support.checkpoint_builder import official_model, saved, stripped
from support.colcon_workspace import REPOSITORY
from support.formula_model import ExpectedPredictions, formula_pixels, formula_tensors
from yolov5_lifecycle.checkpoints.pickled_objects import Stub, tensors_of
from yolov5_lifecycle.checkpoints.yaml_architecture import architecture_of
from yolov5_lifecycle.models.architecture import Architecture
from yolov5_lifecycle.models.network import Network

_QUICK = (
    *("v3.0/yolov5s", "v3.1/yolov5s", "v5.0/yolov5s-transformer", "zoo", "zoo-relu", "yolov3-tiny"),
    *("yolov5n-ch1", "yolov5n-act-LeakyReLU", "yolov5s-ghost", "yolov5-p2", "yolov3-spp-depth0.33"),
    "yolov5n-seg",
)


@functools.cache
def families() -> Mapping[str, Any]:
    """The entries of the data by name: era and model, without an era for the newest code."""
    found: Mapping[str, Any] = json.loads((REPOSITORY / "test" / "data" / "families.json").read_text())
    return found


EVERY_FAMILY = [
    pytest.param(name, marks=() if name in _QUICK else pytest.mark.long, id=name) for name in families()
]
QUICK_FAMILIES = list(_QUICK)


def expected_family(name: str) -> ExpectedPredictions:
    found = families()[name]
    return ExpectedPredictions.of(found, found["tolerance"], families()[found.get("same_numbers_as", name)])


def family_architecture(name: str, **changes: object) -> Architecture:
    """The architecture of an entry, with the activations that its modules have."""
    found = families()[name]
    anchors_px = tuple(tuple(map(tuple, level)) for level in found["anchors_px"])
    architecture = architecture_of(
        found["yaml"],
        classes=found["yaml"]["nc"],
        anchors_px=anchors_px,
        strides=tuple(found["strides"]),
        image_channels=found["image_channels"],
    )
    others = tuple((path, activation) for path, activation in found.get("other_activations", []))
    architecture = dataclasses.replace(architecture, activation=found["activation"], other_activations=others)
    return dataclasses.replace(architecture, **changes)  # type: ignore[arg-type]  # of any field


def family_network(name: str) -> Network:
    """The network of an entry with the weights of the formula, in evaluation mode."""
    network = Network(family_architecture(name))
    anchors = {key: tensor for key, tensor in network.state_dict().items() if key.endswith(".anchors")}
    network.load_state_dict(dict(formula_tensors(network.state_dict())) | anchors)
    return network.eval()


def is_before_v6(name: str) -> bool:
    return name.startswith(("v3.", "v4.", "v5."))


def family_checkpoint(name: str, **options: Any) -> bytes:
    """The model of an entry as its version of YOLOv5 saves it, in float32; `options` of `official_model`."""
    network = family_network(name)
    classes = network.architecture.classes
    kind = "Model" if name.startswith(("v3.", "v4.", "v5.", "v6.0", "v6.1")) else "DetectionModel"
    kind = "SegmentationModel" if network.architecture.mask_coefficients else kind
    model = official_model(
        network.architecture,
        [f"class {index}" for index in range(classes)],
        kind=f"models.yolo.{kind}",
        half=False,
        network=network,
        before_v6=is_before_v6(name),
        **options,
    )
    model.yaml = families()[name]["yaml"] | ({} if is_before_v6(name) else {"ch": model_channels(name)})
    return saved(stripped(model))


def model_channels(name: str) -> int:
    channels: int = families()[name]["image_channels"]
    return channels


def state_dict_digest(modules: Mapping[str, Stub]) -> str:
    """SHA-256 of the names and shapes of all tensors in a file."""
    shapes = {key: list(tensor.shape) for key, tensor in tensors_of(modules)}
    return hashlib.sha256(json.dumps(shapes, sort_keys=True).encode()).hexdigest()


def modules_digest(modules: Mapping[str, Stub]) -> str:
    """SHA-256 of the paths of all modules in a file, with the names of their classes."""
    lines = sorted(f"{path} {module.kind}" for path, module in modules.items() if path not in ("", "model"))
    return hashlib.sha256("\n".join(lines).encode()).hexdigest()


def family_pixels(name: str) -> torch.Tensor:
    """Network input (1, c, h, w) in [0, 1]."""
    return formula_pixels(tuple(families()[name]["input_shape"]))
