"""Check that the modules in a checkpoint match our network in more than keys and shapes.

A different activation, epsilon or wiring leaves every tensor shape unchanged but makes every detection wrong.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from torch import nn
from torch.nn.modules.linear import NonDynamicallyQuantizableLinear

from yolov5_lifecycle.checkpoints.module_tree import Stub
from yolov5_lifecycle.checkpoints.yaml_architecture import layer_sources
from yolov5_lifecycle.models.bottlenecks import Bottleneck, CrossConv
from yolov5_lifecycle.models.convolutions import Conv, DWConv, MixConv2d
from yolov5_lifecycle.models.head import Segment
from yolov5_lifecycle.models.model import WeightsError, shown
from yolov5_lifecycle.models.network import Concat, Network
from yolov5_lifecycle.models.partial import CrossCSP
from yolov5_lifecycle.models.resizing import Contract, Expand

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
