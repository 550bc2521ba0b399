"""Checkpoints as YOLOv5 writes them, of models that cannot be used, each wrong in one thing."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import nn

from support.checkpoint_builder import (
    foreign,
    head,
    layers_of,
    official_model,
    pickled_method,
    saved,
    stripped,
)
from support.small_families import SMALL_FAMILIES

NAN = math.nan


def changed(change: Callable[[Any], object], **options: Any) -> Callable[[], bytes]:
    """The small official model after `change`."""

    def make() -> bytes:
        model = official_model(**options)
        change(model)
        return saved(stripped(model))

    return make


def yaml(**entries: object) -> Callable[[], bytes]:
    return changed(lambda model: model.yaml.update(entries))


def row(index: int, *cells: object) -> Callable[[], bytes]:
    """Row `index` of the yaml's backbone is [from, number, module, arguments] = `cells`."""
    return changed(lambda model: model.yaml["backbone"].__setitem__(index, list(cells)))


def module_at(model: Any, path: str) -> Any:
    """The module at `path`; at "" the model itself."""
    for name in filter(None, path.split(".")):
        model = vars(model)["_modules"][name]
    return model


def setting(path: str, **values: object) -> Callable[[], bytes]:
    return changed(lambda model: vars(module_at(model, path)).update(values))


def child(path: str, **modules: object) -> Callable[[], bytes]:
    return changed(lambda model: vars(module_at(model, path))["_modules"].update(modules))


def renamed(index: str, name: str) -> Callable[[], bytes]:
    """Layer `index` is of another class."""

    def rename(model: Any) -> None:
        layers_of(model)[index] = foreign(name, **vars(layers_of(model)[index]))

    return changed(rename)


def anchors(values: object) -> Callable[[], bytes]:
    """Anchors in grid cells."""
    return changed(lambda model: vars(head(model))["_buffers"].update(anchors=torch.tensor(values)))


def segmentation(**attributes: object) -> Callable[[], bytes]:
    """A segmentation model whose head has other `attributes` than it should."""
    architecture = SMALL_FAMILIES["segmentation"]
    return changed(lambda model: vars(head(model)).update(attributes), architecture=architecture)


def fuse_all(model: Any) -> None:
    """As YOLOv5's model.fuse(): no bn, a bias, and forward is another method of the same object."""
    for layer in layers_of(model).values():
        if type(layer).__name__ == "Conv":
            inside = vars(layer)["_modules"]
            del inside["bn"]
            inside["conv"].bias = nn.Parameter(torch.zeros(inside["conv"].out_channels))
            vars(layer)["forward"] = pickled_method(layer, "forward_fuse")


def data_parallel(module: Any) -> nn.DataParallel[Any]:
    wrapper = nn.DataParallel.__new__(nn.DataParallel)
    vars(wrapper).update(_modules={"module": module}, src_device_obj=torch.device("cpu"))
    return wrapper


def data_parallel_of_itself() -> bytes:
    wrapper = data_parallel(None)
    vars(wrapper)["_modules"]["module"] = wrapper
    return saved({"model": wrapper})


def ensemble() -> bytes:
    """As YOLOv5's attempt_load makes it of several files."""
    return saved(
        foreign("models.experimental.Ensemble", _modules={"0": official_model(), "1": official_model()})
    )


MODELS: Mapping[str, tuple[Callable[[], bytes], str]] = {
    "list": (lambda: saved([1, 2]), "expected a dict with the entry 'model', found [1, 2]"),
    "dict of something else": (
        lambda: saved({"weights": 1, "epoch": 2}),
        "it holds no model, only ['weights', 'epoch']: use the best.pt",
    ),
    "model None": (
        lambda: saved({"model": None, "epoch": 2}),
        "it holds no model, because 'model' is None: use the best.pt or last.pt",
    ),
    "averaged model that is a pair of nothing": (
        lambda: saved({"model": None, "ema": (None, 7)}),
        "expected a YOLOv5 model under 'ema' or 'model', found [None, 7]",
    ),
    "ensemble": (ensemble, "it is an Ensemble of 2 models, and one model is expected: use the .pt of one"),
    "dict in place of the model": (lambda: saved({"model": {"a": 1}}), "expected a YOLOv5 model under"),
    "bare state dict": (lambda: saved(nn.Conv2d(3, 4, 1).state_dict()), "a bare state dict"),
    "state dict in an entry": (
        lambda: saved({"state_dict": nn.Conv2d(3, 4, 1).state_dict(), "epoch": 2}),
        "a bare state dict",
    ),
    "ultralytics model": (
        lambda: saved({"model": foreign("ultralytics.nn.tasks.DetectionModel")}),
        "belongs to the ultralytics package",
    ),
    "segmentation without coefficients": (segmentation(nm=None), "the coefficients of masks: expected"),
    "segmentation with other coefficients": (segmentation(nm=16), "gives 16 numbers per box, expected 24"),
    "classification": (
        renamed("8", "models.common.Classify"),
        "is a 'Classify', the head of a classification model",
    ),
    "DataParallel of nothing": (lambda: saved({"model": data_parallel(None)}), "expected a model inside"),
    "DataParallel of itself": (data_parallel_of_itself, "one that contains itself"),
    "images of four channels": (yaml(ch=4), "reads images of 4 channels"),
    "never trained": (
        anchors([[[0.0, 0.25], [0.5, 0.75]], [[0.0, 0.125], [0.25, 0.375]]]),
        "was never trained: its anchors are still the placeholders",
    ),
    "empty first layer": (
        changed(lambda model: vars(layers_of(model)["0"])["_modules"].clear()),
        "the module model.0.conv is missing",
    ),
    "YOLOv7": (renamed("8", "models.yolo.IDetect"), "another project, named YOLOv7"),
    "unknown head": (renamed("8", "models.custom.MyHead"), "'MyHead', not supported"),
    "unknown block": (renamed("2", "models.custom.MyBlock"), "is a 'MyBlock', expected C3"),
    "sum of layers": (row(0, -1, 1, "Sum", [2]), "none of its models uses as a layer"),
    "pool without arguments": (row(1, -1, 1, "nn.MaxPool2d", []), "the kernel of layer 1"),
    "uneven padding": (row(1, -1, 1, "nn.ZeroPad2d", [[0, 1, 0, 2]]), "not supported"),
    "padding that fits nothing": (row(1, -1, 1, "nn.ZeroPad2d", [[0, 1, 0, 1]]), "of different sizes"),
    "too few channels for squares": (row(1, -1, 1, "Expand", [8]), "8 channels cannot become squares"),
    "windows that descend": (row(4, -1, 1, "SPP", [64, [9, 5]]), "has the arguments"),
    "expansion NaN": (row(2, -1, 3, "C3", [64, True, 1, NAN]), "has the arguments"),
    "attention that shares badly": (
        row(2, -1, 1, "C3TR", [64, True, 1, 0.7]),
        "cannot be divided among 4 attention heads",
    ),
    "large anchors in pixels, which are not read": (
        changed(lambda model: vars(head(model))["_buffers"].update(anchor_grid=torch.zeros(20_000_000))),
        "bytes that belong to no layer",
    ),
    "NMS added for an export": (
        child("model", **{"9": foreign("models.common.NMS", _modules={}, f=-1)}),
        "which YOLOv5 before 6.0 added for an export",
    ),
    "other activation": (
        child("model.0", act=nn.GELU()),
        "is a 'GELU': the model was trained with another activation",
    ),
    "activation of another package": (
        child("model.0", act=foreign("models.common.SiLU")),
        "is a 'SiLU': the model was trained with another activation",
    ),
    "fused": (changed(fuse_all), "saved after fuse()"),
    "classes as a text": (setting("model.8", nc="3"), "expected an integer from 1 to 10000, found '3'"),
    "two names": (setting("", names=["cat", "dog"]), "expected names of 3 classes, found 2 names"),
    "name that is an object": (
        setting("", names=["cat", foreign("models.common.Conv"), "cow"]),
        "strings or numbers, found a models.common.Conv: set model.names",
    ),
    "too many strides": (setting("", stride=torch.ones(9)), "expected the strides of 1 to 8 levels"),
    "stride NaN": (setting("", stride=torch.tensor([NAN, 8])), "expected strides from 1 to 1024"),
    "other strides": (setting("", stride=torch.tensor([8.0, 16])), "but its layers produce"),
    "no anchors": (changed(lambda model: vars(head(model))["_buffers"].clear()), "expected anchors"),
    "flat anchors": (anchors([[1.0, 2], [3, 4]]), "expected anchors (width, height) for 2 levels"),
    "anchors of three levels": (anchors([[[1.0, 2], [3, 4]]] * 3), "for 2 levels, found the shape (3, 2, 2)"),
    "anchors of three sides": (anchors([[[1.0, 2, 3]] * 2] * 2), "for 2 levels, found the shape (2, 2, 3)"),
    "three anchors for a head of two": (anchors([[[1.0, 2]] * 3] * 2), "model.8.m.0.weight has the shape"),
    "yaml missing": (setting("", yaml=None), "expected a dict as the model's yaml"),
    "yaml without a backbone": (yaml(backbone=None), "expected a list of layers as backbone"),
    "row of three": (row(0, -1, 1, "Conv"), "[from, number, module, arguments] as layer 0"),
    "slope of 7": (child("model.1", act=nn.LeakyReLU(7.0)), "act.negative_slope is 7.0, expected 0 to 1"),
    "epsilon": (setting("model.2.cv1.bn", eps=1e-5), "model.2.cv1.bn.eps is 1e-05, expected 0.001"),
    "stride": (
        setting("model.1.conv", stride=(1, 1)),
        "model.1.conv.stride is [1, 1], expected [2, 2]",
    ),
    "dilation": (setting("model.1.conv", dilation=(2, 2)), "dilation is [2, 2]"),
    "padding mode": (setting("model.1.conv", padding_mode="reflect"), "'reflect', expected 'zeros'"),
    "pool": (setting("model.4.m", kernel_size=9), "model.4.m.kernel_size is 9, expected 5"),
    "scale": (setting("model.5", scale_factor=3.0), "scale_factor is 3.0, expected 2.0"),
    "axis": (setting("model.6", d=2), "model.6.d is 2, expected 1"),
    "shortcut": (setting("model.7.m.0", add=True), "m.0.add is True, expected False"),
    "levels swapped": (setting("model.8", f=[4, 7]), "model.8 reads other layers"),
    "no wiring": (setting("model.6", f=None), "the input of layer 6"),
    "one module more": (
        child("model.7", gate=foreign("models.common.CBAM", _modules={})),
        "'model.7.gate', a 'CBAM', is no part of YOLOv5",
    ),
    "one module less": (child("model.4", m=None), "model.4.m is missing, expected MaxPool2d"),
}
