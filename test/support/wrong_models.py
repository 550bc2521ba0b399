"""Checkpoints as YOLOv5 writes them, of models that cannot be used, each wrong in one thing."""

from __future__ import annotations

import contextlib
import datetime
import math
from collections.abc import Callable, Iterator, Mapping
from contextvars import ContextVar
from typing import Any

import torch
from torch import nn

from support.checkpoint_builder import (
    SMALL,
    foreign,
    head,
    layers_of,
    official_model,
    pickled_method,
    saved,
    stripped,
)
from support.small_families import SMALL_FAMILIES
from yolov5_lifecycle.models.architecture import Architecture

NAN, INFINITY = math.nan, math.inf
_BASE: ContextVar[Architecture] = ContextVar("_BASE", default=SMALL)


@contextlib.contextmanager
def based_on(architecture: Architecture) -> Iterator[None]:
    """The models are wrong in the same things, but of `architecture`; it must have the layers of SMALL."""
    token = _BASE.set(architecture)
    try:
        yield
    finally:
        _BASE.reset(token)


def right_model(**options: Any) -> Any:
    return official_model(_BASE.get(), **options)


def changed(change: Callable[[Any], object], **options: Any) -> Callable[[], bytes]:
    """The small official model after `change`."""

    def make() -> bytes:
        model = right_model(**options)
        change(model)
        return saved(stripped(model))

    return make


def yaml(**entries: object) -> Callable[[], bytes]:
    return changed(lambda model: model.yaml.update(entries))


def row(index: int, *cells: object) -> Callable[[], bytes]:
    """Row `index` of the yaml's backbone is [from, number, module, arguments] = `cells`."""
    return changed(lambda model: model.yaml["backbone"].__setitem__(index, list(cells)))


def own(**attributes: object) -> Callable[[], bytes]:
    return changed(lambda model: vars(model).update(attributes))


def of_head(**attributes: object) -> Callable[[], bytes]:
    return changed(lambda model: vars(head(model)).update(attributes))


def tensor(key: str, change: Callable[[torch.Tensor], object]) -> Callable[[], bytes]:
    """The parameter or buffer `key` of the first convolution after `change`, in place."""
    return changed(lambda model: change(_first(model)[key].data))


def _first(model: Any) -> dict[str, Any]:
    inside = vars(layers_of(model)["0"])["_modules"]
    return {**dict(inside["conv"].named_parameters()), **inside["bn"].state_dict(keep_vars=True)}


def first_layer(kind: str, **more: object) -> Callable[[], bytes]:
    """More `_modules` or `_parameters` in the first layer."""
    return changed(lambda model: vars(layers_of(model)["0"])[kind].update(more))


def anchors(values: object) -> Callable[[], bytes]:
    """Anchors in grid cells."""
    return changed(lambda model: vars(head(model))["_buffers"].update(anchors=torch.tensor(values)))


def head_named(name: str) -> Callable[[], bytes]:
    def rename(model: Any) -> None:
        layers_of(model)[str(len(layers_of(model)) - 1)] = foreign(name, **vars(head(model)))

    return changed(rename)


def layer_named(name: str) -> Callable[[], bytes]:
    def rename(model: Any) -> None:
        layers_of(model)["2"] = foreign(name, **vars(layers_of(model)["2"]))

    return changed(rename)


def recursive_yaml() -> bytes:
    model = right_model()
    model.yaml["backbone"].append(model.yaml["backbone"])
    return saved(stripped(model))


def segment_head_of_detection() -> bytes:
    model = right_model(kind="models.yolo.SegmentationModel")
    layers_of(model)["8"] = foreign("models.yolo.Segment", **vars(head(model)) | {"nm": 32, "npr": 64})
    vars(head(model))["no"] = 5 + 3 + 32
    return saved(stripped(model))


def segmentation(**attributes: object) -> Callable[[], bytes]:
    """A segmentation model whose head has other `attributes` than it should."""

    def build() -> bytes:
        model = official_model(SMALL_FAMILIES["segmentation"], kind="models.yolo.SegmentationModel")
        vars(head(model)).update(attributes)
        return saved(stripped(model))

    return build


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
    return saved(foreign("models.experimental.Ensemble", _modules={"0": right_model(), "1": right_model()}))


def state_dict() -> dict[str, torch.Tensor]:
    return nn.Conv2d(3, 4, 1).state_dict()


def fused(model: Any) -> None:
    inside = vars(layers_of(model)["0"])["_modules"]
    del inside["bn"]
    inside["conv"].bias = nn.Parameter(torch.zeros(8))


MODELS: Mapping[str, tuple[Callable[[], bytes], str]] = {
    "list": (lambda: saved([1, 2]), "expected a dict with the entry 'model', found [1, 2]"),
    "text": (lambda: saved("yolov5n"), "found 'yolov5n'"),
    "empty dict": (lambda: saved({}), "it holds no model, only []"),
    "dict of something else": (
        lambda: saved({"weights": 1, "epoch": 2}),
        "it holds no model, only ['weights', 'epoch']: use the best.pt",
    ),
    "model None": (
        lambda: saved({"model": None, "epoch": 2}),
        "it holds no model, because 'model' is None: use the best.pt or last.pt",
    ),
    "model and averaged model None": (
        lambda: saved(stripped(None)),
        "it holds no model, because 'ema' and 'model' is None",
    ),
    "averaged model that is a pair of nothing": (
        lambda: saved({"model": None, "ema": (None, 7)}),
        "expected a YOLOv5 model under 'ema' or 'model', found [None, 7]",
    ),
    "ensemble": (ensemble, "it is an Ensemble of 2 models, and one model is expected: use the .pt of one"),
    "dict in place of the model": (lambda: saved({"model": {"a": 1}}), "expected a YOLOv5 model under"),
    "bare state dict": (lambda: saved(state_dict()), "a bare state dict"),
    "state dict as the model": (lambda: saved({"model": state_dict()}), "a bare state dict"),
    "bare torch module": (lambda: saved(nn.Conv2d(3, 4, 1)), "found a 'Conv2d' without layers"),
    "model without layers": (
        lambda: saved({"model": foreign("models.yolo.Model", _modules={})}),
        "without layers",
    ),
    "ultralytics model": (
        lambda: saved({"model": foreign("ultralytics.nn.tasks.DetectionModel")}),
        "belongs to the ultralytics package",
    ),
    "segmentation in the head only": (
        segment_head_of_detection,
        "is a 'Segment', expected Detect",
    ),
    "segmentation without coefficients": (segmentation(nm=None), "the coefficients of masks: expected"),
    "segmentation with other coefficients": (segmentation(nm=16), "gives 16 numbers per box, expected 24"),
    "segmentation with endless coefficients": (
        segmentation(nm=1 << 60),
        "the coefficients of masks: expected",
    ),
    "segmentation of detections only": (segmentation(no=8), "gives 8 numbers per box, expected 16"),
    "classification": (
        head_named("models.common.Classify"),
        "is a 'Classify', the head of a classification model",
    ),
    "NMS in place of the head": (head_named("models.common.NMS"), "expected Detect"),
    "DataParallel of nothing": (lambda: saved({"model": data_parallel(None)}), "expected a model inside"),
    "DataParallel of itself": (data_parallel_of_itself, "one that contains itself"),
    "row that is another module": (row(1, -1, 1, "nn.MaxPool2d", [2, 2, 0]), "expected MaxPool2d"),
    "grey images": (yaml(ch=1), "model.0.conv.weight has the shape"),
    "images of four channels": (yaml(ch=4), "reads images of 4 channels"),
    "channels as a truth value": (yaml(ch=True), "reads images of True channels"),
    "no channel multiple": (yaml(channel_multiple=0), "the channel_multiple"),
    "another channel multiple": (yaml(channel_multiple=16), "expected"),
    "channels as a list": (yaml(ch=[3]), "reads images of [3] channels"),
    "never trained": (
        anchors([[[0.0, 0.25], [0.5, 0.75]], [[0.0, 0.125], [0.25, 0.375]]]),
        "was never trained: its anchors are still the placeholders",
    ),
    "YOLOv7": (head_named("models.yolo.IDetect"), "another project, named YOLOv7"),
    "unknown head": (head_named("models.custom.MyHead"), "'MyHead', not supported"),
    "unknown block": (layer_named("models.custom.MyBlock"), "is a 'MyBlock', expected C3"),
    "Focus in the yaml only": (row(0, -1, 1, "Focus", [64, 3]), "is a 'Conv', expected Focus"),
    "unknown row": (row(0, -1, 1, "os.system", ["true"]), "'os.system', not supported"),
    "sum of layers": (row(0, -1, 1, "Sum", [2]), "none of its models uses as a layer"),
    "even ghost": (row(0, -1, 1, "GhostConv", [64, 4, 2]), "has the arguments [64, 4, 2]"),
    "channels that are no multiple of eight": (
        changed(lambda model: model.yaml.update(channel_multiple=1, width_multiple=0.2)),
        "expected",
    ),
    "pool without arguments": (row(1, -1, 1, "nn.MaxPool2d", []), "the kernel of layer 1"),
    "pool without a stride": (row(1, -1, 1, "nn.MaxPool2d", [2]), "the stride of layer 1"),
    "pool of a list": (row(1, -1, 1, "nn.MaxPool2d", [[2, 2], 2]), "the kernel of layer 1"),
    "uneven padding": (row(1, -1, 1, "nn.ZeroPad2d", [[0, 1, 0, 2]]), "not supported"),
    "padding of a million": (row(1, -1, 1, "nn.ZeroPad2d", [[0, 10**6, 0, 10**6]]), "the padding of layer 1"),
    "padding that fits nothing": (row(1, -1, 1, "nn.ZeroPad2d", [[0, 1, 0, 1]]), "of different sizes"),
    "squares that do not fit": (row(1, -1, 1, "Contract", [3]), "the strides are"),
    "squares of a million": (row(1, -1, 1, "Contract", [10**6]), "the gain of layer 1"),
    "too few channels for squares": (row(1, -1, 1, "Expand", [8]), "8 channels cannot become squares"),
    "windows that descend": (row(4, -1, 1, "SPP", [64, [9, 5]]), "has the arguments"),
    "a thousand windows": (row(4, -1, 1, "SPP", [64, [3] * 1000]), "has the arguments"),
    "windows in windows": (row(4, -1, 1, "SPP", [64, [[5], [9]]]), "the kernel of layer 4"),
    "expansion NaN": (row(2, -1, 3, "C3", [64, True, 1, NAN]), "has the arguments"),
    "expansion to nothing": (row(2, -1, 3, "C3", [64, True, 1, 0.01]), "a convolution without channels"),
    "groups that do not divide": (row(2, -1, 3, "C3", [64, True, 3]), "no network can be built"),
    "a million groups": (row(2, -1, 3, "C3", [64, True, 10**6]), "the groups of layer 2"),
    "stride of nine": (row(1, -1, 1, "Conv", [64, 3, 9]), "the stride of layer 1"),
    "attention that shares badly": (
        changed(lambda model: model.yaml["backbone"].__setitem__(2, [-1, 1, "C3TR", [64, True, 1, 0.7]])),
        "cannot be divided among 4 attention heads",
    ),
    "anchors in pixels of another shape": (
        changed(lambda model: vars(head(model))["_buffers"].update(anchor_grid=torch.ones(3, 1))),
        "expected anchors in pixels of the levels",
    ),
    "other activation": (
        first_layer("_modules", act=nn.GELU()),
        "is a 'GELU': the model was trained with another activation",
    ),
    "activation of another package": (
        first_layer("_modules", act=foreign("models.common.SiLU")),
        "is a 'SiLU': the model was trained with another activation",
    ),
    "slope NaN": (first_layer("_modules", act=nn.LeakyReLU(NAN)), "negative_slope is nan"),
    "slope as a text": (first_layer("_modules", act=nn.LeakyReLU("0.1")), "negative_slope is '0.1'"),  # type: ignore[arg-type]  # on purpose
    "fused": (changed(fuse_all), "saved after fuse()"),
    "without one normalisation": (changed(fused), "saved after fuse()"),
    "other epsilon": (
        changed(lambda model: setattr(vars(layers_of(model)["0"])["_modules"]["bn"], "eps", 1e-5)),
        "model.0.bn.eps is 1e-05, expected 0.001",
    ),
    "other wiring": (
        changed(lambda model: vars(layers_of(model)["6"]).update(f=[-1, 1])),
        "reads other layers",
    ),
    "no classes": (of_head(nc=0), "the number of classes"),
    "a million classes": (of_head(nc=1_000_000), "the number of classes"),
    "classes as a text": (of_head(nc="3"), "expected an integer from 1 to 10000, found '3'"),
    "classes as a truth value": (of_head(nc=True), "the number of classes"),
    "more outputs than classes": (of_head(no=40), "gives 40 numbers per box"),
    "other number of classes": (of_head(nc=4, no=9), "expected names of 4 classes"),
    "two names": (own(names=["cat", "dog"]), "expected names of 3 classes, found 2 names"),
    "no names": (own(names=None), "expected names of 3 classes"),
    "names that are lists": (own(names=["cat", ["dog"], "cow"]), "strings or numbers, found a list: set"),
    "name that is an object": (
        own(names=["cat", foreign("models.common.Conv"), "cow"]),
        "strings or numbers, found a models.common.Conv: set model.names",
    ),
    "name that is a day": (
        own(names=["cat", datetime.date(2024, 1, 2), "cow"]),
        "strings or numbers, found a datetime.date: set model.names",
    ),
    "name that is a tensor": (own(names=["cat", torch.ones(2), "cow"]), "strings or numbers, found a Stored"),
    "name that is a number of 300 digits": (own(names=["cat", 10**300, "cow"]), "found a huge number: set"),
    "name of 201 characters": (own(names=["cat", "x" * 201, "cow"]), "name of 201 characters, more than 200"),
    "name of 200 escapes": (own(names=["cat", "\x1b" * 200, "cow"]), "name of 800 characters, more than 200"),
    "names of other numbers": (own(names={1: "cat", 2: "dog", 3: "cow"}), "from 0 to 2, found 3: set"),
    "names of negative numbers": (own(names={-1: "cat", 0: "dog", 1: "cow"}), "from 0 to 2, found -1"),
    "names by name": (own(names={"cat": 0, "dog": 1, "cow": 2}), "from 0 to 2, found 'cat'"),
    "names of truth values": (own(names={False: "cat", True: "dog"}), "from 0 to 2, found False"),
    "names of one number": (own(names={0: "cat", "0": "dog"}), "found two with the same index"),
    "no strides": (own(stride=None), "expected the strides of 1 to 8 levels"),
    "strides as a list": (own(stride=[4, 8]), "expected the strides of 1 to 8 levels"),
    "too many strides": (own(stride=torch.ones(9)), "expected the strides of 1 to 8 levels"),
    "half a stride": (own(stride=torch.tensor([4.5, 8])), "expected strides from 1 to 1024"),
    "stride NaN": (own(stride=torch.tensor([NAN, 8])), "expected strides from 1 to 1024"),
    "stride zero": (own(stride=torch.tensor([0.0, 8])), "expected strides from 1 to 1024"),
    "other strides": (own(stride=torch.tensor([8.0, 16])), "but its layers produce"),
    "one stride": (own(stride=torch.tensor([8.0])), "found the shape (2, 2, 2)"),
    "strides that repeat one number": (own(stride=torch.ones(1).expand(8)), "found the shape (2, 2, 2)"),
    "no anchors": (changed(lambda model: vars(head(model))["_buffers"].clear()), "expected anchors"),
    "flat anchors": (anchors([[1.0, 2], [3, 4]]), "expected anchors (width, height) for 2 levels"),
    "anchor NaN": (anchors([[[NAN, 2.0], [3, 4]], [[1, 2], [3, 4]]]), "anchors"),
    "anchor zero": (anchors([[[0.0, 2], [3, 4]], [[1, 2], [3, 4]]]), "anchors of positive width"),
    "three anchors for a head of two": (anchors([[[1.0, 2]] * 3] * 2), "model.8.m.0.weight has the shape"),
    "weight NaN": (tensor("weight", lambda weight: weight.view(-1)[0].fill_(NAN)), "not finite"),
    "weight infinite": (tensor("weight", lambda weight: weight.view(-1)[0].fill_(INFINITY)), "not finite"),
    "negative variance": (tensor("running_var", lambda variance: variance.fill_(-1)), "negative variances"),
    "surplus tensor": (
        first_layer("_parameters", extra=nn.Parameter(torch.ones(1))),
        "'model.0.extra' belongs to no layer",
    ),
    "surplus module": (
        first_layer("_modules", extra=nn.Identity()),
        "is no part of YOLOv5",
    ),
    "yaml missing": (own(yaml=None), "expected a dict as the model's yaml"),
    "yaml without a backbone": (yaml(backbone=None), "expected a list of layers as backbone"),
    "yaml without layers": (yaml(backbone=[], head=[]), "expected 1 to 200 layers, found 0"),
    "yaml of 201 layers": (yaml(backbone=[[-1, 1, "Conv", [64]]] * 201), "found 2"),
    "yaml that contains itself": (recursive_yaml, "as layer 5, found"),
    "yaml of another width": (yaml(width_multiple=0.25), "expected"),
    "width multiple NaN": (yaml(width_multiple=NAN), "width_multiple from 0.01 to 10, found nan"),
    "depth multiple of a million": (yaml(depth_multiple=1e6), "depth_multiple from 0.01 to 10"),
    "depth multiple as a text": (yaml(depth_multiple="1"), "depth_multiple from 0.01 to 10, found '1'"),
    "row of three": (row(0, -1, 1, "Conv"), "[from, number, module, arguments] as layer 0"),
    "row that reads a later layer": (row(1, 5, 1, "Conv", [64, 3, 2]), "the input of layer 1"),
    "row that reads nothing": (row(1, [], 1, "Conv", [64, 3, 2]), "reads 0 layers"),
    "channels of a million": (row(0, -1, 1, "Conv", [1_000_000, 6, 2]), "the channels of layer 0"),
    "negative channels": (row(0, -1, 1, "Conv", [-64, 6, 2]), "the channels of layer 0"),
    "a million repeats": (row(2, -1, 1_000_000, "C3", [64]), "the number of layer 2"),
    "repeated convolution": (row(1, -1, 9, "Conv", [64, 3, 2]), "but its layers produce"),
    "repeated upsampling": (row(4, -1, 9, "nn.Upsample", ["None", 2, "nearest"]), "is repeated 3 times"),
    "even window": (row(4, -1, 1, "SPPF", [64, 4]), "has the arguments [64, 4]"),
    "kernel of 99": (row(0, -1, 1, "Conv", [64, 99, 2]), "the kernel of layer 0"),
    "even kernel": (row(0, -1, 1, "Conv", [64, 4, 1]), "not supported"),
    "odd shortcut": (row(2, -1, 3, "C3", [64, "False"]), "not supported"),
    "two heads": (row(4, -1, 1, "Detect", []), "expected one Detect or Segment layer, the last, found 2"),
}
