"""Activations and fusion of a pickled network, which neither state dict nor yaml state reliably."""

from __future__ import annotations

import dataclasses
import math
from collections import Counter
from collections.abc import Mapping

from torch import nn

from yolov5_lifecycle.checkpoints.module_tree import Stub
from yolov5_lifecycle.models.activations import ACTIVATIONS, leaky_relu
from yolov5_lifecycle.models.architecture import Architecture
from yolov5_lifecycle.models.convolutions import Conv
from yolov5_lifecycle.models.model import WeightsError, blueprint, shown


def as_pickled(architecture: Architecture, modules: Mapping[str, Stub]) -> Architecture:
    """`architecture` with the activations of `modules`, and fused if they are.

    The modules are known by their paths in the network. Raises WeightsError for an unsupported activation.
    """
    network = blueprint(architecture)
    paths = [path for path, _ in network.named_modules() if path.endswith(".act") and path in modules]
    architecture = with_activations(architecture, {path: _name(path, modules[path]) for path in paths})
    convolutions = [path for path, module in network.named_modules() if isinstance(module, Conv)]
    is_fused = bool(convolutions) and not any(f"{path}.bn" in modules for path in convolutions)
    return dataclasses.replace(architecture, is_fused=is_fused)


def with_activations(architecture: Architecture, names: Mapping[str, str]) -> Architecture:
    """`architecture` with activations by the paths of their modules in the network."""
    made = {path: module for path, module in blueprint(architecture).named_modules() if path in names}
    chosen = [names[path] for path, module in made.items() if isinstance(module, nn.SiLU)]
    usual = Counter(chosen).most_common(1)[0][0] if chosen else architecture.activation
    others = tuple(
        (path, names[path])
        for path, module in made.items()
        if names[path] != (usual if isinstance(module, nn.SiLU) else "Identity")
    )
    return dataclasses.replace(architecture, activation=usual, other_activations=others)


def _name(path: str, module: Stub) -> str:
    if module.kind not in ACTIVATIONS or not module.pickled_name.startswith("torch.nn.modules."):
        raise WeightsError(
            f"the module {path} is a {shown(module.kind)}: the model was trained with another activation "
            f"than {', '.join(ACTIVATIONS)}; only these are supported"
        )
    if module.kind != "LeakyReLU":
        return module.kind
    slope = module.get("negative_slope")
    if isinstance(slope, bool) or not isinstance(slope, (int, float)) or not 0 <= slope <= 1:
        raise WeightsError(f"{path}.negative_slope is {shown(slope)}, expected 0 to 1")
    name = leaky_relu(float(slope))
    if not math.isclose(float(name[10:-1]), slope, rel_tol=1e-7, abs_tol=1e-12):
        raise WeightsError(f"{path}.negative_slope is {shown(slope)}: not supported")
    return name
