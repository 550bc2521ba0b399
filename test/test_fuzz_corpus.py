"""Inputs that `make fuzz` found are still handled correctly."""

from __future__ import annotations

import pytest
from support.colcon_workspace import REPOSITORY

from fuzz.targets import TARGETS

CORPUS = REPOSITORY / "fuzz" / "corpus"
FILES = sorted(CORPUS.glob("*/*"))
LARGEST_BYTES = 4096


def test_every_target_has_a_corpus_of_small_files() -> None:
    assert {file.parent.name for file in FILES} == set(TARGETS)
    assert max(file.stat().st_size for file in FILES) <= LARGEST_BYTES


@pytest.mark.parametrize("name", TARGETS)
def test_the_corpus_of_a_target_passes_its_check(name: str) -> None:
    for file in (file for file in FILES if file.parent.name == name):
        TARGETS[name].check(file.read_bytes())


@pytest.mark.long
@pytest.mark.parametrize("name", TARGETS)
def test_the_seeds_of_a_target_pass_its_check(name: str) -> None:
    for seed in TARGETS[name].seeds():
        TARGETS[name].check(seed)
