"""Hostile and wrong weights files are refused in their own words, at a small cost; nothing in them is run."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest
from support import hostile_archives, hostile_onnx, hostile_pickles, hostile_reader, hostile_safetensors
from support.checkpoint_builder import official_model, saved, stripped
from support.colcon_workspace import REPOSITORY
from support.hostile_pickles import MARKER, Case
from support.random_model import random_model
from support.small_families import COSTLY
from support.wrong_models import MODELS

from yolov5_lifecycle.process.memory import release_unused_memory

MAX_CPU_S = 20
MAX_GROWN_MB = 100
"""The memory of a process may grow by this much while it reads a file; some ask for 16 TB."""


def made(files: Mapping[str, tuple[Callable[[], bytes], str]]) -> Iterator[Case]:
    return ((name, make(), told) for name, (make, told) in files.items())


def checkpoints() -> Iterator[Case]:
    yield from hostile_pickles.hostile_pickles()
    yield from made({**hostile_archives.ARCHIVES, **MODELS})
    for name, (architecture, told) in COSTLY.items():
        names = [f"class {index}" for index in range(architecture.classes)]
        yield name, saved(stripped(official_model(architecture, names))), told


def safetensors() -> Iterator[Case]:
    yield from made(hostile_safetensors.FILES)
    name, (architecture, told) = next(iter(COSTLY.items()))
    yield name, hostile_safetensors.written(random_model(0, architecture)), told


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("hostile")


@pytest.fixture(scope="module")
def cases(folder: Path) -> Mapping[str, tuple[str, str]]:
    """Name and expected refusal of each file by its path."""
    written = {}
    exports = made(hostile_onnx.FILES)
    for suffix, table in ((".pt", checkpoints()), (".safetensors", safetensors()), (".onnx", exports)):
        for index, (name, data, told) in enumerate(table):
            file = folder / f"{index:03}{suffix}"
            file.write_bytes(data)
            written[str(file)] = name, told
    release_unused_memory()  # of the largest files
    return written


@pytest.fixture(scope="module")
def answers(folder: Path, cases: Mapping[str, tuple[str, str]]) -> Sequence[Mapping[str, Any]]:
    """What became of each file in a process that reads all of them."""
    (folder / "valid.pt").write_bytes(hostile_archives.valid())
    workplace = folder / "workplace"
    workplace.mkdir()
    (workplace / f"{MARKER}.py").write_text(f"open({str(workplace / 'imported')!r}, 'w').close()")
    reader = subprocess.run(
        [sys.executable, hostile_reader.__file__, folder / "valid.pt", *cases],
        cwd=workplace,
        env=os.environ | {"PYTHONPATH": f"{workplace}:{REPOSITORY}"},
        capture_output=True,
        text=True,
    )
    assert (reader.returncode, reader.stderr) == (0, "")
    assert [file.name for file in workplace.iterdir()] == [f"{MARKER}.py"], "something was run"
    found = [json.loads(line) for line in reader.stdout.splitlines()]
    assert [answer["path"] for answer in found] == list(cases)
    return found


@pytest.mark.end_to_end
def test_every_file_is_refused_in_its_own_words_and_nothing_in_it_is_run(
    cases: Mapping[str, tuple[str, str]], answers: Sequence[Mapping[str, Any]]
) -> None:
    wrong = {}
    for answer in answers:
        (name, told), message = cases[answer["path"]], answer["message"]
        is_told = told in message and answer["path"] in message and message.isprintable()
        if answer["outcome"] != "WeightsError" or answer["events"] or not is_told or len(message) > 999:
            wrong[name] = answer
    assert wrong == {}


@pytest.mark.end_to_end
def test_no_file_takes_up_the_memory_or_the_time(answers: Sequence[Mapping[str, Any]]) -> None:
    slowest = max(answers, key=lambda answer: answer["cpu_s"])
    assert slowest["cpu_s"] < MAX_CPU_S, slowest
    largest = max(answers, key=lambda answer: answer["grown_mb"])
    assert largest["grown_mb"] < MAX_GROWN_MB, largest
