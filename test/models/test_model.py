"""What every model keeps, whatever file it comes from, and how the content of files is shown."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from support.checkpoint_builder import SMALL
from support.random_model import CLASS_NAMES, random_network

from yolov5_lifecycle.models.class_names import MAX_NAME_LENGTH
from yolov5_lifecycle.models.model import (
    WeightsError,
    blueprint,
    check_class_names,
    checked_integer,
    checked_model,
    first_line,
    shown,
)


def test_a_model_shares_no_memory_with_what_it_was_made_of() -> None:
    tensors = dict(random_network(0, SMALL).state_dict())
    both = torch.ones(2, 8)
    tensors["model.0.bn.weight"], tensors["model.0.bn.bias"] = both
    weight = "model.0.conv.weight"
    tensors[weight] = tensors[weight].contiguous(memory_format=torch.channels_last)
    model = checked_model(SMALL, CLASS_NAMES, tensors)
    for tensor in tensors.values():
        tensor.zero_()
    assert bool((model.state_dict["model.0.bn.weight"] == 1).all())
    storages = {tensor.untyped_storage().data_ptr() for tensor in model.state_dict.values()}
    assert len(storages) == len(model.state_dict)
    assert all(
        tensor.untyped_storage().nbytes() == tensor.nbytes and tensor.is_contiguous()
        for tensor in model.state_dict.values()
    )


def test_a_blueprint_takes_no_memory() -> None:
    assert {tensor.device.type for tensor in blueprint(SMALL).state_dict().values()} == {"meta"}


@pytest.mark.parametrize(
    "layer",
    [
        pytest.param(SMALL.layers[0]._replace(args=(1 << 70, 6, 2)), id="too many channels"),
        pytest.param(SMALL.layers[0]._replace(sources=(99,)), id="no such layer"),
        pytest.param(SMALL.layers[0]._replace(kind="SPPF"), id="strange kernel"),
        pytest.param(SMALL.layers[2]._replace(args=()), id="no arguments"),
    ],
)
def test_layers_that_make_no_network_are_refused(layer: object) -> None:
    layers = (layer, *SMALL.layers[1:])
    with pytest.raises(WeightsError):
        checked_model(dataclasses.replace(SMALL, layers=layers), CLASS_NAMES, {})  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("names", "message"),
    [
        pytest.param("cat", "expected names of 3 classes, found 'cat'", id="a text"),
        pytest.param(["a", "b"], "found 2 names", id="too few"),
        pytest.param({0: "a", 1: "b", 3: "c"}, "numbered from 0 to 2, found 3", id="a number too large"),
        pytest.param(["a", "b", "c" * (MAX_NAME_LENGTH + 1)], "201 characters, more than 200", id="too long"),
        pytest.param(["a", "b", "\x1b" * 200], "name of 800 characters, more than 200", id="escapes"),
        pytest.param(["a", "b", ["c"]], "strings or numbers, found a list", id="a list"),
        pytest.param(["a", "b", 10**300], "found a huge number", id="a huge number"),
        pytest.param({0: "a", "0": "b"}, "found two with the same index", id="an index twice"),
        pytest.param({-1: "a", False: "b"}, "from 0 to 2, found -1", id="a negative number"),
        pytest.param({False: "a"}, "from 0 to 2, found False", id="a truth value"),
    ],
)
def test_names_that_do_not_fit_are_refused(names: object, message: str) -> None:
    with pytest.raises(WeightsError) as refused:
        check_class_names(names, 3)
    assert message in str(refused.value)
    assert str(refused.value).endswith(": set model.names and save the checkpoint again")


@pytest.mark.parametrize("value", [True, 1.0, "1", None, 0, 9, torch.tensor(1)], ids=repr)
def test_anything_but_an_integer_in_range_is_refused(value: object) -> None:
    with pytest.raises(WeightsError, match="the size: expected an integer from 1 to 8, found"):
        checked_integer(value, "the size", 1, 8)


def test_of_an_error_of_several_lines_the_first_is_told() -> None:
    assert first_line(ValueError("no such thing\n  at line 3")) == "ValueError: no such thing"


def doubled(levels: int) -> object:
    value: object = "ha"
    for _ in range(levels):
        value = (value, value)
    return value


@pytest.mark.parametrize(
    ("value", "text"),
    [
        pytest.param(doubled(200), "[a tuple, a tuple]", id="doubles with each level"),
        pytest.param([*range(9)], "[0, 1, 2, 3, 4, 5, 6, 7, ...]", id="long list"),
        pytest.param("a" * 200, f"'{'a' * 59}...", id="long text"),
        pytest.param(10**200, f"1{'0' * 59}...", id="long number"),
        pytest.param("\x1b\n\ud800", r"'\x1b\n\ud800'", id="control characters"),
        pytest.param(type("T" * 200, (), {})(), f"a {'T' * 60}", id="long class"),
        pytest.param(b"bytes", "a bytes", id="bytes"),
    ],
)
def test_any_value_is_shown_in_one_short_line(value: object, text: str) -> None:
    assert shown(value) == text
