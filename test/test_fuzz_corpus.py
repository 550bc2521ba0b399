"""Inputs that `make fuzz` found are still handled correctly."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.colcon_workspace import REPOSITORY

from fuzz.targets import TARGETS

CORPUS = REPOSITORY / "fuzz" / "corpus"
FILES = sorted(CORPUS.glob("*/*"))
LARGEST_BYTES = 4096


def test_every_target_has_a_corpus() -> None:
    assert {file.parent.name for file in FILES} == set(TARGETS)


@pytest.mark.long
@pytest.mark.parametrize("name", TARGETS)
def test_a_seed_of_a_target_passes_its_check(name: str) -> None:
    for seed in TARGETS[name].seeds():
        TARGETS[name].check(seed)


@pytest.mark.long
@pytest.mark.parametrize("name", TARGETS)
@given(data=st.binary(max_size=600))
@settings(max_examples=50)
def test_any_bytes_pass_the_check_of_a_target(name: str, data: bytes) -> None:
    TARGETS[name].check(data)


@pytest.mark.parametrize("file", FILES, ids=lambda file: f"{file.parent.name} {file.name[:8]}")
def test_a_file_of_the_corpus_is_small_and_passes_its_check(file: Path) -> None:
    data = file.read_bytes()
    assert len(data) <= LARGEST_BYTES
    TARGETS[file.parent.name].check(data)
