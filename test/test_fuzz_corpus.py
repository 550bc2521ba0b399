"""Inputs that `make fuzz` found are still handled correctly."""

from __future__ import annotations

import pytest
from support.colcon_workspace import REPOSITORY

from fuzz.targets import TARGETS

CORPUS = REPOSITORY / "fuzz" / "corpus"


@pytest.mark.parametrize("name", TARGETS)
def test_the_corpus_of_a_target_passes_its_check(name: str) -> None:
    files = list((CORPUS / name).iterdir())
    assert files
    for file in files:
        TARGETS[name].check(file.read_bytes())


@pytest.mark.long
@pytest.mark.parametrize("name", TARGETS)
def test_the_seeds_of_a_target_pass_its_check(name: str) -> None:
    for seed in TARGETS[name].seeds():
        TARGETS[name].check(seed)
