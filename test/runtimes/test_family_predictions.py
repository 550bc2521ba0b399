"""Every compiled runtime predicts what YOLOv5's own implementation predicts, for every family."""

from __future__ import annotations

import pytest
from support.compiled_networks import engine, predicted
from support.families import EVERY_FAMILY, expected_family, family_network, family_pixels
from support.runtime_names import COMPILED_RUNTIMES

from yolov5_lifecycle.models.model import Model

_FIRST, *_OTHERS = COMPILED_RUNTIMES
RUNTIMES = [_FIRST, *(pytest.param(*each.values, marks=[*each.marks, pytest.mark.long]) for each in _OTHERS)]
"""The ten official networks are compared in every runtime soon, see test_formula_predictions.py."""


@pytest.mark.long
@pytest.mark.parametrize("name", EVERY_FAMILY)
@pytest.mark.parametrize("runtime_name", RUNTIMES)
def test_a_compiled_network_predicts_what_the_official_one_predicts(runtime_name: str, name: str) -> None:
    network = family_network(name)
    model = Model(network.architecture, (), network.state_dict())
    expected_family(name).check(predicted(model, engine(runtime_name), family_pixels(name).numpy()))
