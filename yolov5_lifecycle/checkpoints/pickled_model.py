"""The model among the objects of a checkpoint, its attributes, and the settings of its modules.

A different activation, epsilon or wiring leaves every tensor shape unchanged but makes every detection wrong.
"""

from __future__ import annotations

import dataclasses
import math
from collections import Counter
from collections.abc import Callable, Mapping
from types import MappingProxyType

import torch
from torch import Tensor, nn
from torch.nn.modules.linear import NonDynamicallyQuantizableLinear

from yolov5_lifecycle.checkpoints.pickled_objects import StoredTensor, Stub
from yolov5_lifecycle.checkpoints.yaml_architecture import (
    MAX_ANCHORS,
    MAX_COEFFICIENTS,
    MAX_LEVELS,
    layer_kind,
    layer_sources,
)
from yolov5_lifecycle.models.architecture import AnchorsPx, Architecture
from yolov5_lifecycle.models.blocks import Bottleneck, Contract, CrossConv, Expand
from yolov5_lifecycle.models.convolutions import ACTIVATIONS, Conv, DWConv, MixConv2d, leaky_relu
from yolov5_lifecycle.models.cost import MAX_STRIDE
from yolov5_lifecycle.models.head import HEADS, Segment
from yolov5_lifecycle.models.model import MAX_CLASSES, WeightsError, blueprint, checked_integer, shown
from yolov5_lifecycle.models.network import Concat, Network

_WRAPPERS: Mapping[str, str] = MappingProxyType(
    {
        "DataParallel": "module",
        "DistributedDataParallel": "module",
        "AutoShape": "model",
        "autoShape": "model",
        "DetectMultiBackend": "model",
    }
)
"""Wrappers of a model (for several GPUs, for inference) and the attribute that holds it."""
_MAX_WRAPPERS = 4
_ENTRIES = ("ema", "model")
"""Of a checkpoint; the first that holds a model is read, as YOLOv5 does."""
_PLACEHOLDER_ANCHORS_PX = tuple((float(2 * index), float(2 * index + 1)) for index in range(MAX_ANCHORS))
"""Anchors that YOLOv5 creates for `anchors: 3` in the yaml of P2, P34, P6 and P7 models."""

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
        nn.BatchNorm2d: ("BatchNorm2d", "SyncBatchNorm"),  # trained with --sync-bn; the same but for training
        NonDynamicallyQuantizableLinear: ("NonDynamicallyQuantizableLinear", "_LinearWithBias"),
    }
)
"""Names in files of classes that have more than one."""

Read = Callable[[StoredTensor], Tensor]


def model_root(checkpoint: object) -> Stub:
    """The model in a checkpoint, its `ema` if present, unwrapped. Raises WeightsError."""
    found = _saved_module(checkpoint)
    for _ in range(_MAX_WRAPPERS):
        if found.kind not in _WRAPPERS:
            break
        inside = found.group("_modules").get(_WRAPPERS[found.kind])
        if not isinstance(inside, Stub):
            raise WeightsError(f"expected a model inside {found.kind}, found {shown(inside)}")
        found = inside
    return found


def _saved_module(checkpoint: object) -> Stub:
    if isinstance(checkpoint, Stub):
        return checkpoint
    if not isinstance(checkpoint, dict):
        raise WeightsError(f"expected a dict with the entry 'model', found {shown(checkpoint)}")
    for key in _ENTRIES:
        if isinstance(module := _averaged(checkpoint.get(key)), Stub):
            return module
    states = [checkpoint, *(checkpoint.get(key) for key in (*_ENTRIES, "state_dict"))]
    if any(isinstance(state, dict) and _holds_tensors(state) for state in states):
        raise WeightsError(
            "this is a bare state dict, without the model's yaml and class names: use the original .pt"
        )
    raise WeightsError(_nothing_found(checkpoint))


def _averaged(entry: object) -> object:
    """The model in an entry; between v4.0 and v5.0 `ema` was a pair of model and number of updates."""
    return entry[0] if isinstance(entry, tuple) and len(entry) == 2 else entry


def _nothing_found(checkpoint: Mapping[object, object]) -> str:
    present = [key for key in _ENTRIES if key in checkpoint]
    found = [checkpoint[key] for key in present if checkpoint[key] is not None]
    if found:
        return f"expected a YOLOv5 model under 'ema' or 'model', found {shown(found[-1])}"
    use = "use the best.pt or last.pt that the training wrote"
    if present:
        return f"it holds no model, because {' and '.join(map(repr, present))} is None: {use}"
    return f"it holds no model, only {shown(list(checkpoint))}: {use}"


def _holds_tensors(state: Mapping[object, object]) -> bool:
    return bool(state) and all(isinstance(value, StoredTensor) for value in state.values())


def head_path(modules: Mapping[str, Stub]) -> str:
    """The path of the head, the last layer."""
    layers = [path for path in modules if path.startswith("model.") and path.count(".") == 1]
    if not layers:
        raise WeightsError(_without_layers(modules))
    path = layers[-1]
    if layer_kind(modules[path].kind, "the last layer") not in HEADS:
        raise WeightsError(f"the last layer is a {modules[path].kind}, expected {' or '.join(HEADS)}")
    return path


def _without_layers(modules: Mapping[str, Stub]) -> str:
    root = modules[""]
    if root.kind == "Ensemble":
        models = len(root.group("_modules"))
        return f"it is an Ensemble of {models} models, and one model is expected: use the .pt of one of them"
    return f"expected a YOLOv5 model, found a {shown(root.kind)} without layers"


def classes_of(head: Stub) -> int:
    classes = checked_integer(head.get("nc"), "the number of classes", 1, MAX_CLASSES)
    coefficients = 0
    if head.kind == "Segment":
        coefficients = checked_integer(head.get("nm"), "the coefficients of masks", 1, MAX_COEFFICIENTS)
    outputs, expected = head.get("no"), classes + 5 + coefficients
    if not isinstance(outputs, int) or outputs != expected:
        raise WeightsError(
            f"the last layer gives {shown(outputs)} numbers per box, expected {expected} for {classes} "
            "classes: the head of another kind of model, or a damaged file"
        )
    return classes


def strides_of(root: Stub, read: Read) -> tuple[int, ...]:
    stride = root.get("stride")
    if (
        not isinstance(stride, StoredTensor)
        or len(stride.shape) != 1
        or not 1 <= stride.shape[0] <= MAX_LEVELS
    ):
        raise WeightsError(f"expected the strides of 1 to {MAX_LEVELS} levels, found {shown(stride)}")
    values = read(stride).tolist()
    if not all(value in range(1, MAX_STRIDE + 1) for value in values):
        raise WeightsError(f"expected strides from 1 to {MAX_STRIDE}, found {shown(values)}")
    return tuple(map(int, values))


def anchors_of(anchors: StoredTensor | None, strides: tuple[int, ...], read: Read) -> AnchorsPx:
    """Anchors in pixels from the buffer in grid cells, (levels, anchors, 2)."""
    shape = () if anchors is None else anchors.shape
    if anchors is None or len(shape) != 3 or shape[0] != len(strides) or shape[2] != 2:
        raise WeightsError(
            f"expected anchors (width, height) for {len(strides)} levels, found the shape {shape}"
        )
    if not 1 <= shape[1] <= MAX_ANCHORS:
        raise WeightsError(f"expected 1 to {MAX_ANCHORS} anchors on each level, found {shape[1]}")
    in_pixels = read(anchors).double() * torch.tensor(strides, dtype=torch.float64).view(-1, 1, 1)
    anchors_px = tuple(
        tuple((float(wide), float(high)) for wide, high in level) for level in in_pixels.tolist()
    )
    if all(level == _PLACEHOLDER_ANCHORS_PX[: len(level)] for level in anchors_px):
        raise WeightsError(
            "the model was never trained: its anchors are still the placeholders (0, 1), (2, 3), ..., which "
            "training replaces; train it first"
        )
    return anchors_px


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
    """Until v6.0 a MixConv2d had one group and added its input, which has to be like its output."""
    made = [part for part in module.m if isinstance(part, nn.Conv2d)]
    channels = sum(part.out_channels for part in made)
    may_add = all(part.in_channels == channels and part.stride == (1, 1) for part in made)
    mixed = [part for part in pickled.group("_modules").values() if isinstance(part, Stub)]
    parts = [part for several in mixed for part in several.group("_modules").values()]
    if may_add and all(isinstance(part, Stub) and part.get("groups") == 1 for part in parts):
        raise WeightsError(
            f"the module {path} is a MixConv2d of YOLOv5 before 6.1, which adds its input: not supported"
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
