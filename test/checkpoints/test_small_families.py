"""Every kind of layer is read as each version saves it, fused, trained on several GPUs, or wrapped to run."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from support.checkpoint_builder import (
    SMALL,
    assert_same,
    foreign,
    layers_of,
    official_model,
    pickled_method,
    saved,
    stripped,
)
from support.random_model import random_network
from support.small_families import EVERY_SMALL
from support.wrong_models import data_parallel
from torch import distributed, nn

from yolov5_lifecycle.checkpoints.pt_file import read_checkpoint
from yolov5_lifecycle.checkpoints.safetensors_file import read_safetensors, write_safetensors
from yolov5_lifecycle.models.architecture import Architecture
from yolov5_lifecycle.models.cost import size_multiple
from yolov5_lifecycle.models.model import Model, WeightsError
from yolov5_lifecycle.models.network import Network, fuse

every_small = pytest.mark.parametrize("architecture", EVERY_SMALL.values(), ids=EVERY_SMALL)


def predictions(network: Network) -> torch.Tensor:
    side = 2 * size_multiple(network.architecture)
    shape = (1, network.architecture.image_channels, side, 2 * side)
    with torch.inference_mode():
        raw: torch.Tensor = network.eval()(torch.rand(shape, generator=torch.Generator().manual_seed(0)))
    return raw


def assert_same_model(model: Model, architecture: Architecture, network: Network) -> None:
    assert model.architecture == architecture
    assert torch.equal(predictions(model.network()), predictions(network))


@pytest.mark.long
@every_small
@pytest.mark.parametrize("before_v6", [False, True], ids=["v7", "before v6"])
def test_a_file_of_any_version_is_read(architecture: Architecture, before_v6: bool) -> None:
    if before_v6:  # then a MixConv2d added its input
        layers = tuple(
            layer._replace(kind="Conv", args=(64, 3, 1)) if layer.kind == "MixConv2d" else layer
            for layer in architecture.layers
        )
        others = tuple(pair for pair in architecture.other_activations if pair[0] == "model.0.act")
        architecture = dataclasses.replace(architecture, layers=layers, other_activations=others)
    data = saved(stripped(official_model(architecture, half=False, before_v6=before_v6)))
    assert_same_model(read_checkpoint(data), architecture, random_network(0, architecture))


@every_small
def test_folding_leaves_the_predictions_as_they_are(architecture: Architecture) -> None:
    network = random_network(1, architecture)
    expected = predictions(network)
    folded = fuse(fuse(network))
    assert not [module for module in folded.modules() if isinstance(module, nn.BatchNorm2d)]
    assert not any(parameter.requires_grad for parameter in folded.parameters())
    np.testing.assert_allclose(predictions(folded), expected, rtol=1e-3, atol=1e-4, equal_nan=False)


def fused(architecture: Architecture, method: str) -> Any:
    """As YOLOv5's model.fuse() leaves it: convolutions with a bias, whose forward is another method."""
    is_fused = dataclasses.replace(architecture, is_fused=True)
    model = official_model(is_fused, half=False)
    waiting = list(layers_of(model).values())
    while waiting:
        module = waiting.pop()
        waiting.extend(vars(module)["_modules"].values())
        if type(module).__name__ in ("Conv", "DWConv"):
            vars(module)["forward"] = pickled_method(module, method)
    return model


@pytest.mark.long
@every_small
def test_a_fused_model_is_read_and_converted(architecture: Architecture, tmp_path: Path) -> None:
    method = "forward_fuse" if architecture.activation == "SiLU" else "fuseforward"  # its name before v6
    model = read_checkpoint(saved(stripped(fused(architecture, method))))
    is_fused = dataclasses.replace(architecture, is_fused=True)
    assert_same_model(model, is_fused, random_network(0, is_fused))
    write_safetensors(model, tmp_path / "fused.safetensors")
    again = read_safetensors((tmp_path / "fused.safetensors").read_bytes())
    assert_same_model(again, is_fused, random_network(0, is_fused))
    expected = predictions(model.network())
    np.testing.assert_allclose(
        predictions(fuse(model.network())), expected, rtol=1e-3, atol=1e-4, equal_nan=False
    )


@pytest.mark.parametrize(
    "checkpoint",
    [
        pytest.param(lambda model: model, id="bare module"),
        pytest.param(lambda model: {"model": data_parallel(model)}, id="DataParallel"),
        pytest.param(lambda model: data_parallel(data_parallel(model)), id="bare, twice"),
        pytest.param(
            lambda model: foreign("models.common.autoShape", _modules={"model": model}), id="autoShape"
        ),
        pytest.param(
            lambda model: foreign(
                "models.common.AutoShape",
                _modules={"model": foreign("models.common.DetectMultiBackend", _modules={"model": model})},
            ),
            id="as torch.hub loads it",
        ),
    ],
)
def test_what_is_around_a_model_is_left_out(checkpoint: Callable[[Any], Any]) -> None:
    architecture = EVERY_SMALL["cross-stage"]
    data = saved(checkpoint(official_model(architecture, half=False)))
    assert_same_model(read_checkpoint(data), architecture, random_network(0, architecture))


@pytest.mark.long
def test_a_model_of_a_training_on_several_machines_is_read(tmp_path: Path) -> None:
    distributed.init_process_group("gloo", init_method=f"file://{tmp_path / 'group'}", rank=0, world_size=1)
    try:
        wrapper = nn.parallel.DistributedDataParallel(nn.Linear(1, 1))
        vars(wrapper)["_modules"]["module"] = official_model(half=False)
        data = saved({"model": wrapper})
    finally:
        distributed.destroy_process_group()
    assert_same_model(read_checkpoint(data), SMALL, random_network(0, SMALL))


def test_images_of_a_model_without_that_entry_in_its_yaml_may_be_grey() -> None:
    architecture = EVERY_SMALL["resized"]
    model = official_model(architecture, before_v6=True)
    assert "ch" not in model.yaml
    assert read_checkpoint(saved(stripped(model))).architecture.image_channels == 1


def test_a_mixed_convolution_that_cannot_add_its_input_is_read_though_it_has_one_group() -> None:
    """Three channels have no group in common with 32: those of before v6.1 could not run here."""
    first = SMALL.layers[0]._replace(kind="MixConv2d", args=(512, (1, 3), 2))
    architecture = dataclasses.replace(SMALL, layers=(first, *SMALL.layers[1:]))
    data = saved(stripped(official_model(architecture, half=False)))
    assert read_checkpoint(data).architecture == architecture


def test_a_mixed_convolution_that_added_its_input_is_refused() -> None:
    model = official_model(EVERY_SMALL["convolutions"], half=False)
    for path, part in named_modules(model):
        if path.startswith("model.2.m."):
            part.groups = 1
    with pytest.raises(WeightsError, match=r"a MixConv2d of YOLOv5 before 6\.1, which adds its input"):
        read_checkpoint(saved(stripped(model)))


def test_a_number_of_channels_that_is_that_of_the_head_is_not_scaled() -> None:
    """As YOLOv5 builds its models: with 27 classes and two anchors, 64 channels stay 64."""
    architecture = dataclasses.replace(EVERY_SMALL["cross-stage"], classes=27)
    names = [f"class {index}" for index in range(27)]
    model = read_checkpoint(saved(stripped(official_model(architecture, names))))
    assert model.state_dict["model.0.conv.weight"].shape[0] == 64
    assert dataclasses.replace(architecture, classes=3).scaled_channels(64) == 8


def named_modules(module: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    yield path, module
    for name, child in vars(module)["_modules"].items():
        yield from named_modules(child, f"{path}.{name}" if path else name)


def attributes(model: Any) -> dict[tuple[str, str], str]:
    """The path of one module for every attribute of every class in `model`; once for those of all classes."""
    found: dict[tuple[str, str], str] = {}
    for path, module in named_modules(model):
        for name in vars(module):
            if name in ("_modules", "_parameters", "_buffers", "training"):
                found.setdefault(("", name), path)
            elif not name.startswith("_"):
                found.setdefault((type(module).__name__, name), path)
    return found


def recursive() -> list[Any]:
    found: list[Any] = []
    found.append(found)
    return found


HOSTILE_VALUES: Mapping[str, Callable[[], Any]] = {
    "nothing": lambda: None,
    "a huge number": lambda: 10**30,
    "a negative number": lambda: -1,
    "no number": lambda: math.nan,
    "a text": lambda: "x" * 10_000,
    "a list of itself": recursive,
    "a foreign object": lambda: foreign("models.evil.Thing", _modules={}),
}


def check_attribute(architecture: Architecture, expected: Model, path: str, name: str, value: object) -> None:
    """Expect that the model with another value is refused, or is the same."""
    model = official_model(architecture)
    vars(dict(named_modules(model))[path])[name] = value
    data = saved(stripped(model))
    try:
        found = read_checkpoint(data)
    except WeightsError:
        return
    assert_same(found, expected, f"{path}.{name}")


@pytest.mark.long
@pytest.mark.parametrize("value", HOSTILE_VALUES.values(), ids=HOSTILE_VALUES)
@pytest.mark.parametrize("architecture", EVERY_SMALL.values(), ids=EVERY_SMALL)
def test_an_attribute_of_any_value_is_refused_or_changes_nothing(
    architecture: Architecture, value: Callable[[], Any]
) -> None:
    model = official_model(architecture)
    expected = read_checkpoint(saved(stripped(model)))
    for (_, name), path in attributes(model).items():
        check_attribute(architecture, expected, path, name, value())
