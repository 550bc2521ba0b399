"""What the modules in a checkpoint say besides keys and shapes: settings, activations, fusion.

A different activation, epsilon or wiring leaves every tensor shape unchanged but makes every detection wrong.
"""

from __future__ import annotations

import dataclasses
import math
from collections import Counter
from collections.abc import Mapping
from types import MappingProxyType

from torch import nn
from torch.nn.modules.linear import NonDynamicallyQuantizableLinear

from yolov5_lifecycle.checkpoints.pickled_objects import Stub
from yolov5_lifecycle.checkpoints.yaml_architecture import layer_sources
from yolov5_lifecycle.models.architecture import Architecture
from yolov5_lifecycle.models.blocks import Bottleneck, Contract, CrossConv, CrossCSP, Expand
from yolov5_lifecycle.models.convolutions import ACTIVATIONS, Conv, DWConv, MixConv2d, leaky_relu
from yolov5_lifecycle.models.head import Segment
from yolov5_lifecycle.models.model import WeightsError, blueprint, shown
from yolov5_lifecycle.models.network import Concat, Network

_CONTAINERS = {"", "model"}
_CONVOLUTION = ("kernel_size", "stride", "padding", "dilation", "groups", "padding_mode")
_SETTINGS: Mapping[type[nn.Module], tuple[str, ...]] = MappingProxyType(
    {
        nn.Conv2d: _CONVOLUTION,
        nn.ConvTranspose2d: (*_CONVOLUTION, "output_padding"),
        nn.MaxPool2d: ("kernel_size", "stride", "padding", "dilation", "ceil_mode"),
        nn.ZeroPad2d: ("padding", "value"),
        nn.BatchNorm2d: ("eps", "track_running_stats"),
        nn.Upsample: ("scale_factor", "mode", "size", "align_corners"),
        nn.LeakyReLU: ("negative_slope",),
        nn.MultiheadAttention: ("embed_dim", "num_heads", "add_zero_attn"),
        Bottleneck: ("add",),
        CrossConv: ("add",),
        Contract: ("gain",),
        Expand: ("gain",),
    }
)
"""The attributes that affect a module's output besides its tensors, with the same names in the file."""
_OTHER_CLASS_NAMES: Mapping[type[nn.Module], tuple[str, ...]] = MappingProxyType(
    {
        DWConv: ("DWConv", "Conv"),  # until v5.0 it was a function that made the other class
        CrossCSP: ("C3",),
        nn.BatchNorm2d: ("BatchNorm2d", "SyncBatchNorm"),  # trained with --sync-bn; the same but for training
        NonDynamicallyQuantizableLinear: ("NonDynamicallyQuantizableLinear", "_LinearWithBias"),
    }
)
"""Names in files of classes that have more than one."""


def check_settings(modules: Mapping[str, Stub], network: Network) -> None:
    """Raise WeightsError unless pickled modules match those of `network` in kind, settings and wiring."""
    expected = {path: module for path, module in network.named_modules() if path not in _CONTAINERS}
    if network.architecture.is_fused:
        for path in [path for path, module in expected.items() if isinstance(module, Conv)]:
            del expected[f"{path}.bn"]
    for path, module in expected.items():
        _check_module(path, modules.get(path), module)
    for index, layer in enumerate(network.architecture.layers):
        if layer_sources(modules[f"model.{index}"].get("f"), index) != layer.sources:
            raise WeightsError(f"the module model.{index} reads other layers than the model's yaml says")
    if surplus := modules.keys() - expected.keys() - _CONTAINERS:
        path = min(surplus)
        raise WeightsError(f"the module {shown(path)}, a {shown(modules[path].kind)}, is no part of YOLOv5")


def _check_module(path: str, pickled: Stub | None, module: nn.Module) -> None:
    names = _OTHER_CLASS_NAMES.get(type(module), (type(module).__name__,))
    if pickled is None and isinstance(module, nn.BatchNorm2d):
        raise WeightsError(
            f"the module {path} is missing: the model was saved after fuse(), which merges normalisation "
            "into convolutions, but not into all of them; use the checkpoint of the training"
        )
    if pickled is None or pickled.kind not in names:
        found = "is missing" if pickled is None else f"is a {shown(pickled.kind)}"
        raise WeightsError(
            f"the module {path} {found}, expected {names[0]}: only the building blocks of the official "
            "YOLOv5 models are supported"
        )
    if isinstance(module, MixConv2d):
        _check_mixed(path, pickled, module)
    for name, value in _settings(module).items():
        if not _same(pickled.get(name), value):
            raise WeightsError(f"{path}.{name} is {shown(pickled.get(name))}, expected {shown(value)}")
    if isinstance(module, nn.MultiheadAttention) and pickled.get("batch_first") not in (None, False):
        raise WeightsError(f"{path}.batch_first is True, expected False")


def _check_mixed(path: str, pickled: Stub, module: MixConv2d) -> None:
    """Until v6.0 a MixConv2d had one group and added its input."""
    mixed = [part for part in pickled.group("_modules").values() if isinstance(part, Stub)]
    parts = [part for several in mixed for part in several.group("_modules").values()]
    if all(isinstance(part, Stub) and part.get("groups") == 1 for part in parts) and _may_add(module):
        raise WeightsError(
            f"the module {path} is a MixConv2d of YOLOv5 before 6.1, which adds its input: not supported"
        )


def _may_add(module: MixConv2d) -> bool:
    convolutions = [part for part in module.m if isinstance(part, nn.Conv2d)]
    channels_out = sum(convolution.out_channels for convolution in convolutions)
    return all(
        convolution.in_channels == channels_out and convolution.stride == (1, 1)
        for convolution in convolutions
    )


def _settings(module: nn.Module) -> dict[str, object]:
    """The attributes that affect a module's output besides its tensors, by their names in the file."""
    if isinstance(module, Concat):
        return {"d": 1}
    if isinstance(module, Segment):
        return {"nm": module.coefficients}
    return {
        name: getattr(module, name)
        for kind, names in _SETTINGS.items()
        if isinstance(module, kind)
        for name in names
    }


def _same(found: object, expected: object) -> bool:
    """Equality for untrusted values: compares tuples item by item, otherwise numbers, text and None only."""
    if expected is None:
        return found is None
    if isinstance(expected, tuple):
        if not isinstance(found, (tuple, list)) or len(found) != len(expected):
            return False
        return all(map(_same, found, expected))
    return isinstance(found, (int, float, str)) and found == expected


def as_pickled(architecture: Architecture, modules: Mapping[str, Stub]) -> Architecture:
    """`architecture` with the activations of `modules`, and fused if they are.

    The modules are known by their paths in the network. Raises WeightsError for an unsupported activation.
    """
    made = dict(blueprint(architecture).named_modules())
    names = {
        path: _activation_name(path, modules[path])
        for path in made
        if path.endswith(".act") and path in modules
    }
    chosen = Counter(name for path, name in names.items() if isinstance(made[path], nn.SiLU))
    usual = chosen.most_common(1)[0][0] if chosen else architecture.activation
    convolutions = [path for path, module in made.items() if isinstance(module, Conv)]
    return dataclasses.replace(
        architecture,
        activation=usual,
        other_activations=tuple(
            (path, name)
            for path, name in names.items()
            if name != (usual if isinstance(made[path], nn.SiLU) else "Identity")
        ),
        is_fused=bool(convolutions) and not any(f"{path}.bn" in modules for path in convolutions),
    )


def _activation_name(path: str, module: Stub) -> str:
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
