"""What is wrong with a file is found whatever kinds of layers its model has, at the same small cost."""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest
import torch
from support.checkpoint_builder import foreign, official_model, saved, stripped
from support.hostile_files import MAX_GROWN_MB, Table, read_all, write_tables
from support.small_families import EVERY_SMALL, SMALL_FAMILIES
from support.wrong_models import MODELS, based_on
from torch import nn

from yolov5_lifecycle.checkpoints.pt_file import read_checkpoint
from yolov5_lifecycle.models.architecture import Architecture
from yolov5_lifecycle.models.model import Model, WeightsError

MAX_CPU_S = 20


def of_family(architecture: Architecture, make: Callable[[], bytes]) -> bytes:
    with based_on(architecture):
        return make()


@pytest.mark.long
@pytest.mark.parametrize("family", SMALL_FAMILIES)
def test_what_is_wrong_is_refused_in_every_family(family: str, tmp_path: Path) -> None:
    table: Table = {
        name: (functools.partial(of_family, SMALL_FAMILIES[family], make), told)
        for name, (make, told) in MODELS.items()
    }
    found = read_all(tmp_path, lambda folder: write_tables(folder, {".pt": table}))
    assert found.keys() == MODELS.keys()
    for name, answer in found.items():
        assert answer.is_refused, (name, answer)
        assert answer.message.isprintable()
        assert len(answer.message) < 1000
        assert answer.events == []
    assert max(answer.cpu_s for answer in found.values()) < MAX_CPU_S
    assert max(answer.grown_mb for answer in found.values()) < MAX_GROWN_MB


def modules_of(module: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    yield path, module
    for name, child in vars(module)["_modules"].items():
        yield from modules_of(child, f"{path}.{name}" if path else name)


def attributes(model: Any) -> dict[tuple[str, str], str]:
    """The path of one module for every attribute of every class in `model`; once for those of all classes."""
    found: dict[tuple[str, str], str] = {}
    for path, module in modules_of(model):
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
    vars(dict(modules_of(model))[path])[name] = value
    data = saved(stripped(model))
    try:
        found = read_checkpoint(data)
    except WeightsError:
        return
    assert found.architecture == expected.architecture, (path, name)
    assert found.class_names == expected.class_names, (path, name)
    same = (torch.equal(found.state_dict[key], tensor) for key, tensor in expected.state_dict.items())
    assert all(same), (path, name)


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


@pytest.mark.long
def test_attributes_of_some_values_are_refused_or_change_nothing() -> None:
    """Each attribute of each class has one of the values, in turns."""
    values = itertools.cycle(HOSTILE_VALUES.values())
    seen: set[tuple[str, str]] = set()
    for architecture in EVERY_SMALL.values():
        model = official_model(architecture)
        expected = read_checkpoint(saved(stripped(model)))
        found = attributes(model)
        for key in [key for key in found if key not in seen]:
            check_attribute(architecture, expected, found[key], key[1], next(values)())
        seen |= found.keys()


def deeply_nested(model: Any) -> None:
    inner: Any = nn.Identity()
    for _ in range(60):
        inner = foreign("models.common.Conv", _modules={"conv": inner})
    vars(model)["_modules"]["model"] = inner


def thousands_of_layers(model: Any) -> None:
    layers = vars(model)["_modules"]["model"]
    vars(layers)["_modules"] = {str(index): nn.Identity() for index in range(12_000)}


@pytest.mark.long
@pytest.mark.parametrize(
    "change", [pytest.param(deeply_nested, id="deep"), pytest.param(thousands_of_layers, id="many")]
)
def test_modules_without_end_are_refused(change: Callable[[Any], None]) -> None:
    model = official_model()
    change(model)
    with pytest.raises(WeightsError):
        read_checkpoint(saved(stripped(model)))
