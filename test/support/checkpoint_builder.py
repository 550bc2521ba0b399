"""Files as YOLOv5 writes them, made of our own network: pickled objects of classes that exist nowhere."""

from __future__ import annotations

import contextlib
import io
import sys
from collections.abc import Iterator
from types import ModuleType
from typing import Any

import torch
from torch import nn

from support.random_model import CLASS_NAMES, random_network
from yolov5_lifecycle.models.architecture import Architecture, Layer
from yolov5_lifecycle.models.model import Model
from yolov5_lifecycle.models.network import Network

SMALL = Architecture(
    depth_multiple=0.33,
    width_multiple=0.125,
    classes=len(CLASS_NAMES),
    anchors_px=(((10, 13), (16, 30)), ((30, 61), (62, 45))),
    strides=(4, 8),
    layers=(
        Layer((-1,), 1, "Conv", (64, 6, 2)),
        Layer((-1,), 1, "Conv", (64, 3, 2)),
        Layer((-1,), 3, "C3", (64,)),
        Layer((-1,), 1, "Conv", (64, 3, 2)),
        Layer((-1,), 1, "SPPF", (64, 5)),
        Layer((-1,), 1, "Upsample"),
        Layer((-1, 2), 1, "Concat"),
        Layer((-1,), 1, "C3", (64, 0)),
        Layer((7, 4), 1, "Detect"),
    ),
)
"""One layer of each kind: quick to write and to read."""
_CLASSES: dict[str, type] = {}
_ELSEWHERE = {"MixConv2d": "experimental", "Detect": "yolo", "Segment": "yolo"}
"""Where v7 has the classes that are not in models.common."""
_ELSEWHERE_BEFORE_V6 = _ELSEWHERE | dict.fromkeys(
    ("GhostConv", "GhostBottleneck", "CrossConv"), "experimental"
)
_OF_TORCH = ("Upsample", "MaxPool2d", "ZeroPad2d", "ConvTranspose2d")
_ATTRIBUTES = {*vars(nn.ConvTranspose2d(1, 1, 1)), "add", "gain"}
"""Those of our modules that YOLOv5's have, too."""


def foreign(name: str, **attributes: object) -> Any:
    """An object that is pickled as one of the class `name`, whether that class exists or not."""
    if name not in _CLASSES:
        module, _, qualname = name.rpartition(".")
        _CLASSES[name] = type(qualname, (), {"__module__": module, "__qualname__": qualname})
    made = _CLASSES[name]()
    vars(made).update(attributes)
    return made


def saved(checkpoint: object, protocol: int = 2) -> bytes:
    """`checkpoint` as torch.save writes it."""
    file = io.BytesIO()
    with _importable(_CLASSES):
        torch.save(checkpoint, file, pickle_protocol=protocol)
    return file.getvalue()


@contextlib.contextmanager
def _importable(classes: dict[str, type]) -> Iterator[None]:
    """pickle writes a class only if it can be imported: here it can, for a moment."""
    made: dict[str, ModuleType] = {}
    for name, cls in classes.items():
        parts = name.split(".")
        for end in range(1, len(parts)):
            module = ".".join(parts[:end])
            made.setdefault(module, ModuleType(module))
        setattr(made[".".join(parts[:-1])], parts[-1], cls)
    assert not made.keys() & sys.modules.keys(), "only classes of packages that are not installed"
    sys.modules.update(made)
    try:
        yield
    finally:
        for module in made:
            del sys.modules[module]


def official_model(
    architecture: Architecture = SMALL,
    names: object = CLASS_NAMES,
    *,
    seed: int = 0,
    kind: str = "",
    half: bool = True,
    network: Network | None = None,
    before_v6: bool = False,
) -> Any:
    """The whole pickled model: `vars(model)["_modules"]["model"]` are its layers, the last is the head."""
    network = network or random_network(seed, architecture)
    kind = kind or f"models.yolo.{'Segmentation' if architecture.mask_coefficients else 'Detection'}Model"
    model = _official(network.half() if half else network, kind, before_v6=before_v6)
    layers = vars(model)["_modules"]["model"]
    vars(layers)["_modules"] = {
        key: _placed(child, layer, int(key))
        for (key, child), layer in zip(vars(layers)["_modules"].items(), architecture.layers, strict=True)
    }
    _add_head_attributes(head(model), architecture)
    vars(model).update(
        names=list(names) if isinstance(names, tuple) else names,
        nc=architecture.classes,
        stride=torch.tensor(architecture.strides, dtype=torch.float32),
        yaml=official_yaml(architecture),
        hyp={"lr0": 0.01, "anchor_t": 4.0},
        inplace=True,
        save=[4, 6, 10, 14, 17, 20, 23],
        class_weights=torch.ones(architecture.classes),
    )
    if before_v6:
        del model.yaml["ch"], model.inplace
        _add_anchor_grid(head(model), architecture)
    return model


def _add_head_attributes(head: Any, architecture: Architecture) -> None:
    """What YOLOv5's heads say of themselves; that of segmentation models holds a method of another class."""
    coefficients = architecture.mask_coefficients
    vars(head).update(nc=architecture.classes, no=5 + architecture.classes + coefficients)
    if coefficients:
        detect = pickled_method(type(foreign("models.yolo.Detect")), "forward")
        vars(head).update(nm=coefficients, npr=architecture.prototype_channels, detect=detect)


def pickled_method(owner: object, method: str) -> Any:
    """An object that is pickled as the call getattr(owner, method), as pickle writes a method."""
    return type("Method", (), {"__reduce__": lambda _: (getattr, (owner, method))})()


def _add_anchor_grid(detect: Any, architecture: Architecture) -> None:
    """Before v6.0 a second buffer has the anchors in pixels."""
    buffers = vars(detect)["_buffers"]
    strides = torch.tensor(architecture.strides).view(-1, 1, 1)
    grid = (buffers["anchors"].float() * strides).to(buffers["anchors"].dtype)
    buffers["anchor_grid"] = grid.view(len(grid), 1, -1, 1, 1, 2)


def in_one_storage(model: Any, *, spare: int = 0) -> Any:
    """`model` with its weights as views of one flat storage, which has `spare` more numbers."""
    groups = [vars(module)[name] for module in modules_of(model) for name in ("_parameters", "_buffers")]
    places = [(group, key) for group in groups for key, held in group.items() if _is_weight(held)]
    tensors = [group[key].detach() for group, key in places]
    numbers = torch.cat([tensor.reshape(-1) for tensor in tensors] + [torch.zeros(spare).to(tensors[0])])
    parts = numbers.split([tensor.numel() for tensor in tensors] + [spare])
    for (group, key), tensor, part in zip(places, tensors, parts[:-1], strict=True):
        view = part.view(tensor.shape)
        group[key] = nn.Parameter(view) if isinstance(group[key], nn.Parameter) else view
    return model


def assert_same(found: Model, expected: Model, what: str = "") -> None:
    """Fail, and say `what`, unless both are the same to the bit."""
    assert (found.architecture, found.class_names) == (expected.architecture, expected.class_names), what
    assert found.state_dict.keys() == expected.state_dict.keys(), what
    for key, tensor in expected.state_dict.items():
        assert found.state_dict[key].dtype is tensor.dtype, (what, key)
        assert torch.equal(found.state_dict[key], tensor), (what, key)


def modules_of(module: Any) -> Iterator[Any]:
    yield module
    for child in vars(module)["_modules"].values():
        yield from modules_of(child)


def _is_weight(held: torch.Tensor | None) -> bool:
    return held is not None and held.is_floating_point()


def layers_of(model: Any) -> dict[str, Any]:
    found: dict[str, Any] = vars(vars(model)["_modules"]["model"])["_modules"]
    return found


def head(model: Any) -> Any:
    return list(layers_of(model).values())[-1]


def stripped(model: Any) -> dict[str, Any]:
    """What YOLOv5 leaves after a training: strip_optimizer's dict."""
    return {
        "epoch": -1, "best_fitness": None, "model": model, "ema": None, "updates": None,
        "optimizer": None, "opt": None, "git": None, "date": "2024-01-02T03:04:05",
    }  # fmt: skip


def official_yaml(architecture: Architecture) -> dict[str, Any]:
    rows = [_row(layer) for layer in architecture.layers]
    backbone = 1 + next((index for index, row in enumerate(rows) if row[2] == "SPPF"), len(rows) - 2)
    return {
        "nc": architecture.classes,
        "depth_multiple": architecture.depth_multiple,
        "width_multiple": architecture.width_multiple,
        "anchors": [[side for anchor in level for side in anchor] for level in architecture.anchors_px],
        "backbone": rows[:backbone],
        "head": rows[backbone:],
        "ch": architecture.image_channels,
    }


def _row(layer: Layer) -> list[Any]:
    special: dict[str, list[Any]] = {
        "Upsample": ["None", 2, "nearest"],
        "Concat": [1],
        "Detect": ["nc", "anchors"],
        "Segment": ["nc", "anchors", *layer.args],
        "C3": [*layer.args[:1], *map(bool, layer.args[1:2]), *layer.args[2:]],
    }
    arguments = [*special.get(layer.kind, [_listed(argument) for argument in layer.args])]
    if layer.args[1:2] == (6,):
        arguments.append(2)  # otherwise YOLOv5 pads by half the kernel, which is 3
    sources = layer.sources[0] if len(layer.sources) == 1 else list(layer.sources)
    name = f"nn.{layer.kind}" if layer.kind in _OF_TORCH else layer.kind
    return [sources, layer.repeats, name, arguments]


def _listed(argument: object) -> object:
    return list(argument) if isinstance(argument, tuple) else argument


def _official(module: nn.Module, name: str = "", *, before_v6: bool) -> Any:
    """The module with the project's classes replaced by YOLOv5's; torch's own stay what they are."""
    items = vars(module)["_modules"].items()
    children = {key: _official(child, before_v6=before_v6) for key, child in items}
    kind = type(module)
    own = kind.__module__.startswith("yolov5_lifecycle.")
    if own and kind.__name__ not in _OF_TORCH:
        state = {key: value for key, value in vars(module).items() if key in _ATTRIBUTES}
        if kind.__name__ == "Concat":
            state["d"] = 1
        if isinstance(children.get("bn"), nn.Identity):  # as fuse() leaves it
            del children["bn"]
        return foreign(name or _official_name(kind.__name__, before_v6), **state | {"_modules": children})
    kind = nn.ConvTranspose2d if own else kind
    if kind is nn.ModuleList and any("models.yolo" in type(child).__module__ for child in children.values()):
        kind = nn.Sequential
    copy = kind.__new__(kind)
    vars(copy).update(vars(module) | {"_modules": children})
    return copy


def _official_name(kind: str, before_v6: bool) -> str:
    if before_v6 and kind == "DWConv":
        return "models.common.Conv"
    return f"models.{(_ELSEWHERE_BEFORE_V6 if before_v6 else _ELSEWHERE).get(kind, 'common')}.{kind}"


def _placed(module: Any, layer: Layer, index: int) -> Any:
    """What YOLOv5 adds to each layer: number, sources, name of the class."""
    sources = layer.sources[0] if len(layer.sources) == 1 else list(layer.sources)
    vars(module).update(i=index, f=sources, type=f"models.common.{layer.kind}", np=1)
    return module
