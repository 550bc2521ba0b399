"""Models of the same keys and shapes as ours that compute something else are refused."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from support.checkpoint_builder import foreign, head, layers_of, official_model, saved, stripped
from support.random_model import CLASS_NAMES
from torch import nn

from yolov5_lifecycle.checkpoints.pt_file import read_checkpoint
from yolov5_lifecycle.models.model import WeightsError

Change = Callable[[Any], None]


def children(module: Any) -> dict[str, Any]:
    found: dict[str, Any] = vars(module)["_modules"]
    return found


def module_at(model: Any, path: str) -> Any:
    for name in path.split("."):
        model = children(model)[name]
    return model


def setting(path: str, **values: object) -> Change:
    return lambda model: vars(module_at(model, path)).update(values)


def child(path: str, name: str, module: object) -> Change:
    return lambda model: children(module_at(model, path)).update({name: module})


def missing(path: str, name: str) -> Change:
    return lambda model: children(module_at(model, path)).pop(name)


def fused(model: Any) -> None:
    for layer in layers_of(model).values():
        children(layer).pop("bn", None)


def shared_activation(model: Any) -> None:
    """As YOLOv5 v7 does it: one SiLU object for all layers."""
    activation = nn.SiLU()
    for layer in layers_of(model).values():
        if "act" in children(layer):
            children(layer)["act"] = activation


@pytest.mark.long
@pytest.mark.parametrize(
    ("change", "message"),
    [
        pytest.param(
            child("model.0", "act", nn.GELU()),
            "model.0.act is a 'GELU': the model was trained with another activation",
            id="act",
        ),
        pytest.param(
            child("model.0", "act", foreign("models.common.SiLU")), "with another activation", id="own act"
        ),
        pytest.param(
            child("model.1", "act", nn.LeakyReLU(7.0)),
            "act.negative_slope is 7.0, expected 0 to 1",
            id="slope",
        ),
        pytest.param(
            setting("model.2.cv1.bn", eps=1e-5), "model.2.cv1.bn.eps is 1e-05, expected 0.001", id="epsilon"
        ),
        pytest.param(setting("model.2.cv1.bn", eps=None), "eps is None, expected 0.001", id="no epsilon"),
        pytest.param(
            setting("model.1.conv", stride=(1, 1)),
            "model.1.conv.stride is [1, 1], expected [2, 2]",
            id="stride",
        ),
        pytest.param(setting("model.1.conv", stride=((2,), 2)), "model.1.conv.stride", id="odd stride"),
        pytest.param(
            setting("model.1.conv", padding=(0, 0)), "padding is [0, 0], expected [1, 1]", id="padding"
        ),
        pytest.param(setting("model.1.conv", dilation=(2, 2)), "dilation is [2, 2]", id="dilation"),
        pytest.param(
            setting("model.1.conv", padding_mode="reflect"), "'reflect', expected 'zeros'", id="mode"
        ),
        pytest.param(
            setting("model.4.m", kernel_size=9), "model.4.m.kernel_size is 9, expected 5", id="pool"
        ),
        pytest.param(setting("model.5", mode="bilinear"), "model.5.mode is 'bilinear'", id="upsampling"),
        pytest.param(setting("model.5", scale_factor=3.0), "scale_factor is 3.0, expected 2.0", id="scale"),
        pytest.param(setting("model.6", d=2), "model.6.d is 2, expected 1", id="axis"),
        pytest.param(setting("model.2.m.0", add=False), "m.0.add is False, expected True", id="no shortcut"),
        pytest.param(setting("model.7.m.0", add=True), "m.0.add is True, expected False", id="shortcut"),
        pytest.param(setting("model.6", f=[-1, 1]), "model.6 reads other layers", id="wiring"),
        pytest.param(setting("model.8", f=[4, 7]), "model.8 reads other layers", id="levels swapped"),
        pytest.param(setting("model.6", f=None), "the input of layer 6", id="no wiring"),
        pytest.param(setting("model.6", f=[-1, 40]), "the input of layer 6", id="wired to nowhere"),
        pytest.param(
            child("model.7", "gate", foreign("models.common.CBAM", _modules={})),
            "'model.7.gate', a 'CBAM', is no part of YOLOv5",
            id="one more module",
        ),
        pytest.param(missing("model.4", "m"), "model.4.m is missing, expected MaxPool2d", id="one less"),
        pytest.param(fused, "saved after fuse()", id="fused"),
    ],
)
def test_a_model_that_computes_something_else_is_refused(change: Change, message: str) -> None:
    model = official_model()
    change(model)
    with pytest.raises(WeightsError) as refused:
        read_checkpoint(saved(stripped(model)))
    assert message in str(refused.value)


@pytest.mark.long
@pytest.mark.parametrize(
    "change",
    [
        pytest.param(shared_activation, id="one activation object for all"),
        pytest.param(setting("model.0.act", inplace=False), id="activation not in place"),
        pytest.param(setting("model.0.bn", momentum=0.1), id="momentum, which only training uses"),
        pytest.param(setting("model", training=True), id="saved in training mode"),
        pytest.param(setting("model.6", f=[-1, -4]), id="the same wiring counted back"),
        pytest.param(lambda model: vars(head(model)).update(inplace=False), id="head not in place"),
    ],
)
def test_what_leaves_the_result_alone_is_accepted(change: Change) -> None:
    model = official_model()
    change(model)
    assert read_checkpoint(saved(stripped(model))).class_names == CLASS_NAMES
