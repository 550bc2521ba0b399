"""Check that the modules in a checkpoint match our network in more than keys and shapes.

A different activation, epsilon or wiring leaves every tensor shape unchanged but makes every detection wrong.
"""

from __future__ import annotations

from collections.abc import Mapping

from torch import nn

from yolov5_lifecycle.checkpoints.module_tree import Stub
from yolov5_lifecycle.checkpoints.yaml_architecture import layer_sources
from yolov5_lifecycle.models.model import WeightsError, shown
from yolov5_lifecycle.models.network import Bottleneck, Concat, Network

_CONVOLUTION = ("kernel_size", "stride", "padding", "dilation", "groups", "padding_mode")
_CONTAINERS = {"", "model"}


def check_settings(modules: Mapping[str, Stub], network: Network) -> None:
    """Raise WeightsError unless pickled modules match those of `network` in kind, settings and wiring."""
    expected = {path: module for path, module in network.named_modules() if path not in _CONTAINERS}
    for path, module in expected.items():
        _check_module(path, modules.get(path), module)
    for index, layer in enumerate(network.architecture.layers):
        if layer_sources(modules[f"model.{index}"].get("f"), index) != layer.sources:
            raise WeightsError(f"the module model.{index} reads other layers than the model's yaml says")
    if surplus := modules.keys() - expected.keys() - _CONTAINERS:
        path = min(surplus)
        raise WeightsError(f"the module {shown(path)}, a {shown(modules[path].kind)}, is no part of YOLOv5")


def _check_module(path: str, pickled: Stub | None, module: nn.Module) -> None:
    expected_kind = type(module).__name__
    if pickled is None and isinstance(module, nn.BatchNorm2d):
        raise WeightsError(
            f"the module {path} is missing: the model was saved after fuse(), which merges normalisation "
            "into convolutions; use the checkpoint of the training"
        )
    if pickled is not None and isinstance(module, nn.SiLU) and pickled.kind != expected_kind:
        raise WeightsError(
            f"the module {path} is a {shown(pickled.kind)}: the model was trained with another activation "
            "than SiLU, that of YOLOv5 v6 and v7; only SiLU is supported"
        )
    if pickled is None or pickled.kind != expected_kind:
        found = "is missing" if pickled is None else f"is a {shown(pickled.kind)}"
        raise WeightsError(
            f"the module {path} {found}, expected {expected_kind}: only the building blocks of the official "
            "YOLOv5 models are supported"
        )
    for name, value in _settings(module).items():
        if not _same(pickled.get(name), value):
            raise WeightsError(f"{path}.{name} is {shown(pickled.get(name))}, expected {shown(value)}")


def _settings(module: nn.Module) -> dict[str, object]:
    """The attributes that affect a module's output besides its tensors, by their names in the file."""
    if isinstance(module, nn.Conv2d):
        return {name: getattr(module, name) for name in _CONVOLUTION}
    if isinstance(module, nn.MaxPool2d):
        return {name: getattr(module, name) for name in ("kernel_size", "stride", "padding")}
    if isinstance(module, nn.BatchNorm2d):
        return {"eps": module.eps}
    if isinstance(module, nn.Upsample):
        return {"scale_factor": module.scale_factor, "mode": module.mode}
    if isinstance(module, Bottleneck):
        return {"add": module.shortcut}
    return {"d": 1} if isinstance(module, Concat) else {}


def _same(found: object, expected: object) -> bool:
    """Equality for untrusted values: compares tuples item by item, otherwise int, float and str only."""
    if isinstance(expected, tuple):
        if not isinstance(found, (tuple, list)) or len(found) != len(expected):
            return False
        return all(map(_same, found, expected))
    return isinstance(found, (int, float, str)) and found == expected
